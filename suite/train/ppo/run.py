"""A PPO run in a folder; `suite/train/repeat.py` says what the folder holds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import jax
from jax.sharding import SingleDeviceSharding

from suite.common.console import Console
from suite.common.estimate import Estimate
from suite.train.checks import check
from suite.train.ppo.config import PpoConfig
from suite.train.ppo.update import make_update, start_state
from suite.train.repeat import Method, Outcome, Run, Watch, repeat
from suite.train.worlds import sample_worlds
from tracks.common.files import plain
from tracks.common.work import usable_cores

STEPS_PER_CORE_S = 8000.0
"""Steps of worlds a second that a processor core rolls out, or learns from once; an estimate."""
COMPILE_S = 20.0
"""Time to compile, for the estimate [s]."""


def estimate(config: PpoConfig) -> Estimate:
    """Return about how long a run takes on this machine's devices and what memory it needs."""
    frames = config.episode.batch * config.episode.steps
    pixels = config.spec.camera.height * config.spec.camera.width
    on_cpu = jax.default_backend() == "cpu"
    speed = STEPS_PER_CORE_S * usable_cores() if on_cpu else 50 * STEPS_PER_CORE_S
    seconds = COMPILE_S + config.iterations * frames * (1 + config.epochs) / speed
    return Estimate(seconds, 8e8 + frames * (3 * pixels + 24 * config.spec.hidden_size) * 4.0)


def train_ppo(
    config: PpoConfig, folder: Path, console: Console, watch: Watch | None = None
) -> Outcome:
    """Train until the configured iterations are done; the same call again resumes.

    Args:
        config: the whole run.
        folder: where it lives; a folder with a run of the same configuration is resumed. Its
            policy/ is a checkpoint as any other.
        console: where progress goes.
        watch: measures the policy on the way; its steps are iterations.

    Raises:
        ValueError: where settings cannot be used, and where the folder holds another run.
        WorkFailed: where a number of the curve stops being finite.
    """
    shared = config.shared
    check(shared)
    method = Method(
        iterations=config.iterations,
        frames=config.episode.batch * config.episode.steps,
        estimate=estimate(config),
        worlds=lambda iteration: sample_worlds(shared, iteration),
        make_update=lambda: make_update(config),
        note=_note,
    )
    place = SingleDeviceSharding(jax.devices()[0])
    origin = {"config": plain(config), "from": None, "delta": None, "method": "ppo"}
    run = Run(config, config.spec, config.seed, origin, folder, place)
    return repeat(method, run, start_state(config), console, watch)


def _note(row: Mapping[str, float]) -> str:
    return (
        f"reward {row['reward']:.2f}, gates {row['gates']:.2f}, collided {row['collided']:.0%}, "
        f"{row['speed']:.1f} m/s"
    )

"""A PPO run in a folder; `suite/train/training_loop.py` says what the folder holds."""

from __future__ import annotations

import functools
from pathlib import Path

from suite.common.console import Console
from suite.common.stages import Estimate
from suite.train import run as trainer
from suite.train.config import check
from suite.train.ppo.config import PpoConfig
from suite.train.ppo.update import make_update, start_state
from suite.train.training_loop import Method, Outcome, Run, Watch, flight_note, train_in_folder
from suite.train.worlds import sample_worlds
from tracks.common.files import plain

STEPS_PER_CORE_S = 8000.0
"""Steps of worlds a second that a processor core rolls out, or learns from once; an estimate."""
COMPILE_S = 20.0
"""Time to compile, for the estimate [s]."""


def estimate(config: PpoConfig) -> Estimate:
    """Return about how long a run takes on this machine's devices and what memory it needs."""
    passes = 1 + config.epochs
    return trainer.estimate(config.shared, STEPS_PER_CORE_S, COMPILE_S, passes=passes, images=3)


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
        end=config.iterations,
        spec=config.spec,
        frames=config.episode.batch * config.episode.steps,
        worlds=functools.partial(sample_worlds, shared),
        make_update=lambda: make_update(config),
        note=functools.partial(flight_note, "reward"),
    )
    origin = {"config": plain(config), "from": None, "delta": None, "method": "ppo"}
    run = Run(config, config.seed, origin, folder, estimate(config))
    return train_in_folder([method], run, start_state(config), console, watch)

"""A PPO run in a folder; `suite/train/training_loop.py` describes the folder's files."""

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
"""Environment steps a second of a processor core, in a rollout or a learning pass; a guess."""
COMPILE_S = 20.0
"""Time to compile, for the estimate [s]."""


def estimate(config: PpoConfig) -> Estimate:
    """Return the approximate time and memory of a run on this machine's devices."""
    passes = 1 + config.epochs
    return trainer.estimate(config.shared, STEPS_PER_CORE_S, COMPILE_S, passes=passes, images=3)


def train_ppo(
    config: PpoConfig, folder: Path, console: Console, watch: Watch | None = None
) -> Outcome:
    """Train for the configured iterations; the same call again resumes.

    Args:
        config: the whole run.
        folder: of the run; a run of the same configuration in it is resumed.
        console: shows progress.
        watch: measures the policy during the training; its steps are iterations.

    Raises:
        ValueError: for invalid settings, and if the folder has another run.
        WorkFailed: if a number of the curve is not finite.
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

"""What a loop does, resolved from a recipe and options, and which seeds it flies."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

from suite.common.choices import at_least, is_track_file, parse_levels, parse_tracks
from suite.delta.fit import FitConfig
from suite.train.config import TrainConfig
from suite.train.overrides import override
from suite.train.presets import finetune, preset, with_iterations
from tracks.common.files import to_json

RECORDED_FROM = 100_000
"""Recorded flights have seeds this far above the judged trials', so that none is both."""


@dataclass(frozen=True)
class Size:
    """How much a loop flies and fits."""

    trials: int = 50
    """Judged trials of each policy on every track at every level."""
    flights: int = 20
    """Recorded flights on every track at every level."""
    fit_iterations: int = 1500
    """Gradient steps of the Delta Action Model's fit."""


SIZES = {"small": Size(trials=20, flights=8, fit_iterations=500)}
"""Sizes that go with a recipe; the others have the defaults."""


@dataclass(frozen=True)
class LoopConfig:
    """A whole loop."""

    training: TrainConfig
    """The first training; its physics is what the Delta Action Model corrects."""
    tuning: TrainConfig
    """The fine-tuning, alike with and without the Delta Action Model."""
    fit: FitConfig
    """The fit of the Delta Action Model."""
    policy: str | None
    """The policy to start from instead of training one: a shipped name or a checkpoint's folder."""
    track: str
    """As in `suite.common.choices.parse_tracks`, families only."""
    difficulty: str
    """As in `suite.common.choices.parse_levels`."""
    trials: int
    """Judged trials of each policy on every track at every level."""
    flights: int
    """Recorded flights on every track at every level."""
    vehicle: str
    """A shipped vehicle's name or a vehicle file."""
    seed: int
    """Seed of the training and of the first judged trial."""
    digests: dict[str, str]
    """SHA-256 of what comes from files: the vehicle and, where one is given, the policy."""

    @property
    def recorded_from(self) -> int:
        """Seed of the first recorded flight."""
        return self.seed + RECORDED_FROM

    @property
    def cells(self) -> int:
        """Number of pairs of track and level."""
        return len(parse_tracks(self.track)) * len(parse_levels(self.difficulty))


def resolve(
    *,
    recipe: str,
    policy: str | None = None,
    track: str = "all",
    difficulty: str = "0,3",
    trials: int | None = None,
    flights: int | None = None,
    vehicle: str = "reference",
    seed: int = 0,
    iterations: int | None = None,
    finetune_iterations: int | None = None,
    fit_iterations: int | None = None,
    changes: Sequence[str] = (),
) -> LoopConfig:
    """Return the loop that a recipe and options ask for; None takes the recipe's size.

    Raises:
        ValueError: for an option that cannot be used, naming it and what is allowed.
    """
    from eval.quadrotor.vehicle_file import load_vehicle

    size = SIZES.get(recipe, Size())
    training = replace(preset(recipe), seed=seed)
    if iterations is not None:
        at_least("--iterations", iterations, 1)
        training = with_iterations(training, iterations)
    training = override(training, changes)
    digests = {"vehicle": hashlib.sha256(to_json(load_vehicle(vehicle)).encode()).hexdigest()}
    if policy is not None:
        from policies.formats.policy_file import load_policy_checkpoint
        from suite.judging.flying import checkpoint_folder, policy_digest

        given = load_policy_checkpoint(checkpoint_folder(policy))
        training = replace(training, spec=given.spec)
        digests["policy"] = policy_digest(policy)
    tuning = finetune(training)
    if finetune_iterations is not None:
        at_least("--finetune-iterations", finetune_iterations, 1)
        tuning = with_iterations(tuning, finetune_iterations)
    fitted = size.fit_iterations if fit_iterations is None else fit_iterations
    at_least("--fit-iterations", fitted, 1)
    config = LoopConfig(
        training=training,
        tuning=tuning,
        fit=FitConfig(iterations=fitted, seed=seed),
        policy=policy,
        track=track,
        difficulty=difficulty,
        trials=size.trials if trials is None else trials,
        flights=size.flights if flights is None else flights,
        vehicle=vehicle,
        seed=seed,
        digests=digests,
    )
    check_seeds(config.track, config.difficulty, config.seed, config.trials, config.flights)
    return config


def check_seeds(track: str, difficulty: str, seed: int, trials: int, flights: int) -> None:
    """Check that recorded flights and judged trials can be kept apart.

    Args:
        track: as people write it, and so on.
        difficulty: levels.
        seed: of the first judged trial.
        trials: judged, on every track at every level.
        flights: recorded, on every track at every level.

    Raises:
        ValueError: naming the option and what is allowed.
    """
    names, levels = parse_tracks(track), parse_levels(difficulty)
    files = [name for name in names if is_track_file(name)]
    if files:
        raise ValueError(
            f"--track {files[0]}: a track from a file is the same at every seed, so flights on it "
            "cannot be held apart from trials; give families (zigzag, circular, ellipse)"
        )
    at_least("--seed", seed, 0)
    at_least("--trials", trials, 1)
    at_least("--flights", flights, 1)
    if trials > RECORDED_FROM:
        raise ValueError(
            f"--trials is {trials}; it must be {RECORDED_FROM} or less, since recorded "
            "flights have the seeds above"
        )
    cells = len(names) * len(levels)
    if flights * cells < 2:
        raise ValueError(
            f"--flights is {flights} on {cells} track and level; at least 2 flights "
            "are needed, one of which is held out"
        )

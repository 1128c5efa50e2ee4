"""What a loop in a world with a hidden effect does, resolved from a recipe and options."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

from suite.common.choices import at_least, parse_levels, parse_tracks
from suite.delta.fit import FitConfig
from suite.judging.flying import checkpoint_folder
from suite.loop.config import RECORDED_FROM, check_seeds
from suite.train.config import TrainConfig
from suite.train.overrides import override
from suite.train.presets import finetune, preset, with_iterations, with_quadrotor
from tracks.common.files import to_json


@dataclass(frozen=True)
class HiddenSize:
    """How much a loop with a hidden effect flies and fits, and for how long it fine-tunes."""

    trials: int = 50
    """Judged trials of each policy on every track at every level."""
    flights: int = 5
    """Recorded flights on every track at every level."""
    finetune_iterations: int = 200
    """Gradient steps of each fine-tuning."""
    fit_iterations: int = 400
    """Gradient steps of the fit of a Delta Action Model."""


SIZES = {"small": HiddenSize(trials=20, flights=3, finetune_iterations=100, fit_iterations=200)}
"""Sizes that go with a recipe; the others have the defaults."""


@dataclass(frozen=True)
class HiddenConfig:
    """A whole loop in a world that the simulation's vehicle file does not describe."""

    tuning: TrainConfig
    """The fine-tunings, alike but for what flies in them."""
    fit: FitConfig
    """The fit of a Delta Action Model."""
    policy: str
    """The policy to start from: a shipped name or a checkpoint's folder."""
    track: str
    """As in `suite.common.choices.parse_tracks`, families only."""
    difficulty: str
    """As in `suite.common.choices.parse_levels`."""
    trials: int
    """Judged trials of each policy on every track at every level."""
    flights: int
    """Recorded flights on every track at every level."""
    vehicle: str
    """What the simulation uses: a shipped vehicle's name or a vehicle file."""
    world: str
    """What is true: a vehicle file; nothing but the flights in it is looked at."""
    seed: int
    """Seed of the fine-tunings and of the first judged trial."""
    digests: dict[str, str]
    """SHA-256 of what comes from files: both vehicles and the policy."""

    @property
    def recorded_from(self) -> int:
        """Seed of the first recorded flight."""
        return self.seed + RECORDED_FROM

    @property
    def cells(self) -> int:
        """Number of pairs of track and level."""
        return len(parse_tracks(self.track)) * len(parse_levels(self.difficulty))


def resolve_hidden(
    *,
    world: str,
    recipe: str,
    policy: str | None = None,
    track: str = "all",
    difficulty: str = "0,3",
    trials: int | None = None,
    flights: int | None = None,
    vehicle: str = "reference",
    seed: int = 0,
    finetune_iterations: int | None = None,
    fit_iterations: int | None = None,
    changes: Sequence[str] = (),
) -> HiddenConfig:
    """Return the loop that a recipe and options ask for; None takes the recipe's size.

    Without a policy the shipped default flies.

    Raises:
        ValueError: for an option that cannot be used, naming it and what is allowed.
    """
    from eval.quadrotor.vehicle_file import load_vehicle
    from policies.formats.policy_file import load_policy_checkpoint
    from suite.judging.flying import default_policy, policy_digest

    size = SIZES.get(recipe, HiddenSize())
    base = replace(preset(recipe), seed=seed)
    simulated, true = load_vehicle(vehicle), load_vehicle(world)
    if simulated == true:
        raise ValueError(
            f"--world {world} is the simulation's vehicle {vehicle}: nothing is hidden; give a "
            "vehicle file with an effect more, such as examples/hidden.toml"
        )
    policy = default_policy() if policy is None else policy
    given = load_policy_checkpoint(checkpoint_folder(policy))
    iterations = size.finetune_iterations if finetune_iterations is None else finetune_iterations
    at_least("--finetune-iterations", iterations, 1)
    fitted = size.fit_iterations if fit_iterations is None else fit_iterations
    at_least("--fit-iterations", fitted, 1)
    tuning = finetune(replace(base, spec=given.spec))
    tuning = with_quadrotor(with_iterations(tuning, iterations), simulated)
    config = HiddenConfig(
        tuning=override(tuning, changes),
        fit=FitConfig(iterations=fitted, seed=seed),
        policy=policy,
        track=track,
        difficulty=difficulty,
        trials=size.trials if trials is None else trials,
        flights=size.flights if flights is None else flights,
        vehicle=vehicle,
        world=world,
        seed=seed,
        digests={
            "vehicle": _digest(simulated),
            "world": _digest(true),
            "policy": policy_digest(policy),
        },
    )
    check_seeds(config.track, config.difficulty, config.seed, config.trials, config.flights)
    return config


def _digest(value: object) -> str:
    return hashlib.sha256(to_json(value).encode()).hexdigest()

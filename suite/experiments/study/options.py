"""Options that several experiments have, and the recipe that they select."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, TypeVar

import tyro

from suite.judging.trials import parse_levels
from suite.train.config import TrainConfig
from suite.train.overrides import check_owned
from tracks.common.names import unknown_name
from tracks.input.ranges import Iterations, Range, Seed, Trials, check_ranges

T = TypeVar("T")
"""Type of the entries of `select`."""

GATES = 4
"""Number of gates in the paper's ablation and its comparison of schemes."""


@dataclass(frozen=True)
class JudgingOptions:
    """Options of the experiments that judge policies."""

    policy: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A shipped policy's name, a checkpoint's folder or a policy file; may be given several times.
    Without it the policy race flies."""
    difficulty: str = "3"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials = 32
    """Trials of every policy on every track at every level under every condition."""
    seed: Seed = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""


@dataclass(frozen=True)
class FourGateOptions:
    """Options of the experiments that train on tracks of four gates."""

    recipe: str = "quick"
    """The recipe of all trainings, except for its size, its gates and the compared settings."""
    set: tuple[str, ...] = ("episode.image_stride=3",)
    """Change settings of the recipe by name."""
    iterations: Iterations = 200
    """Gradient steps, instead of the recipe's."""
    worlds: Annotated[int, Range(1, 10**6)] = 48
    """Worlds in one gradient step, instead of the recipe's."""
    training_seeds: tuple[Seed, ...] = (0, 1, 2)
    """Seeds of the trainings."""
    trials: Trials = 300
    """Unseen worlds flown at every measurement."""
    seconds: Annotated[float, Range(0.5, 3600.0)] = 10.0
    """Length of a trial, from a standing start [s]."""
    seed: Seed = 1000
    """Seed of the unseen worlds; must not be a training seed."""


def select(known: Mapping[str, T], only: Sequence[str], kind: str) -> dict[str, T]:
    """Return the entries of `known` whose names are in `only`, or all entries if `only` is empty.

    Raises:
        ValueError: for an unknown name; the message calls an entry `kind`.
    """
    for name in only:
        if name not in known:
            raise unknown_name(kind, name, known)
    return {name: entry for name, entry in known.items() if name in (only or known)}


def check(config: Any) -> None:
    """Refuse the options of an experiment if a value is not allowed.

    Raises:
        ValueError: with the option and what is allowed.
    """
    check_ranges(config, options=True)
    values = vars(config)
    seeds = values.get("training_seeds", (0,))
    if len(set(seeds)) < len(seeds) or not seeds:
        text = " ".join(map(str, seeds)) or "empty"
        raise ValueError(f"--training-seeds is {text}; give each once")
    if isinstance(config, FourGateOptions) and config.seed in seeds:
        raise ValueError(
            f"--seed {config.seed} is one of --training-seeds, whose policies would be measured on "
            "worlds of their training; give another"
        )
    if "difficulty" in values:
        parse_levels(values["difficulty"])


def four_gate_recipe(config: FourGateOptions) -> TrainConfig:
    """Return the recipe that `config` selects, on tracks of four gates.

    Raises:
        ValueError: for an unknown recipe or change, for a recipe with phases, and for one without
            the vector field, since the experiments compare training with the field and without it.
    """
    from suite.train.overrides import check_phases, with_changes
    from suite.train.recipes import named_recipe, with_iterations

    owned = {"episode.batch": "give --worlds", "optimizer.iterations": "give --iterations"}
    owned |= {"seed": "give --training-seeds", "episode.gates": f"all fly {GATES}, as in the paper"}
    check_owned(config.set, owned)
    base = with_iterations(with_changes(named_recipe(config.recipe), config.set), config.iterations)
    if base.phases:
        raise ValueError(
            f"--recipe {config.recipe} has {len(base.phases)} phases, allowed is a recipe without, "
            "such as quick: PPO has none, and the steps of a page are of one length"
        )
    base = replace(base, episode=replace(base.episode, gates=GATES, batch=config.worlds))
    check_phases(base)
    if base.loss.field_gain == 0.0:
        raise ValueError("loss.field_gain is 0, allowed is a number above: the field is compared")
    return base


def recipe_fact(config: FourGateOptions) -> str:
    """Return the recipe and its changes, for the facts of a page."""
    changes = " ".join([*config.set, f"episode.gates={GATES}"])
    return f"`{config.recipe}` of suite train (a named set of settings), with {changes}"


def judged_seeds(config: Any) -> str:
    """Return the first and the last seed of the judged trials as text."""
    return f"{config.seed} to {config.seed + config.trials - 1}"

"""The recipe and the training seeds that an experiment's options ask for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol, TypeVar

from suite.common.choices import at_least

if TYPE_CHECKING:
    from suite.train.config import TrainConfig


class Keyed(Protocol):
    """A row of an experiment."""

    @property
    def key(self) -> str:
        """Its name."""
        ...


Row = TypeVar("Row", bound=Keyed)

GATES = 4
"""Of the paper's tracks in its ablation and its comparison of schemes."""


@dataclass(frozen=True)
class FourGates:
    """What the experiments on tracks of four gates have in common; their options derive from it."""

    preset: str = "racer"
    """The recipe that all trainings share, but for its size, its gates and what is compared."""
    set: tuple[str, ...] = ("episode.image_stride=3",)
    """Change settings of the recipe by name."""
    iterations: int = 200
    """Gradient steps, instead of the preset's."""
    worlds: int = 48
    """Worlds in one gradient step, instead of the preset's."""
    training_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds that everything is trained from."""
    trials: int = 300
    """Unseen worlds that are flown at every measurement."""
    seconds: float = 10.0
    """Of a trial, from standing start."""
    seed: int = 1000
    """Of the unseen worlds; none of the training seeds."""


def asked_recipe(name: str, changes: Sequence[str], iterations: int | None) -> TrainConfig:
    """Return the preset `name` with `changes` and, unless None, its own number of gradient steps.

    Raises:
        ValueError: for a preset, a change or a number that cannot be used.
    """
    from suite.train.overrides import override
    from suite.train.presets import preset, with_iterations

    recipe = override(preset(name), changes)
    if iterations is None:
        return recipe
    at_least("--iterations", iterations, 1)
    return with_iterations(recipe, iterations)


def check_seeds(seeds: Sequence[int]) -> None:
    """Refuse training seeds that cannot be used.

    Raises:
        ValueError: naming the option and what is allowed.
    """
    if len(set(seeds)) < len(seeds) or not seeds:
        said = " ".join(map(str, seeds)) or "empty"
        raise ValueError(f"--training-seeds is {said}; give each once")
    for seed in seeds:
        at_least("--training-seeds", seed, 0)


def check_unseen(option: str, seed: int, training_seeds: Sequence[int]) -> None:
    """Refuse a seed of worlds that a training has seen.

    Raises:
        ValueError: naming the option and what is allowed.
    """
    at_least(option, seed, 0)
    if seed in training_seeds:
        raise ValueError(
            f"{option} {seed} is one of --training-seeds, whose policies would have seen the "
            "worlds they are measured on; give another"
        )


def asked_rows(rows: Sequence[Row], only: Sequence[str], what: str) -> list[Row]:
    """Return the rows whose keys are in `only`, all where it is empty.

    Raises:
        ValueError: for a key that no row has; `what` says what a row is.
    """
    from tracks.common.names import unknown_name

    names = [row.key for row in rows]
    for name in only:
        if name not in names:
            raise unknown_name(what, name, names)
    return [row for row in rows if not only or row.key in only]


def check_owned(changes: Sequence[str], owned: Mapping[str, str]) -> None:
    """Refuse changes of settings that an experiment sets itself and would overwrite.

    Args:
        changes: as --set takes them.
        owned: what to do instead, by a setting's path.

    Raises:
        ValueError: naming the setting and what to do instead.
    """
    for change in changes:
        path = change.partition("=")[0].strip()
        if path in owned:
            raise ValueError(f"--set {change!r}: this experiment sets {path}; {owned[path]}")


def four_gate_recipe(config: FourGates) -> TrainConfig:
    """Return the recipe that `config` asks for on tracks of four gates.

    Raises:
        ValueError: for a preset or a change that does not exist.
    """
    owned = {"episode.batch": "give --worlds", "optimizer.iterations": "give --iterations"}
    check_owned(config.set, {**owned, "episode.gates": f"all fly {GATES}, as in the paper"})
    base = asked_recipe(config.preset, config.set, config.iterations)
    return replace(base, episode=replace(base.episode, gates=GATES, batch=config.worlds))


def check_sizes(config: FourGates) -> None:
    """Refuse numbers that cannot be used.

    Raises:
        ValueError: naming the option and what is allowed.
    """
    check_seeds(config.training_seeds)
    check_unseen("--seed", config.seed, config.training_seeds)
    at_least("--trials", config.trials, 1)
    at_least("--seconds", config.seconds, 0.5)
    at_least("--iterations", config.iterations, 1)
    at_least("--worlds", config.worlds, 1)

"""The recipe and the training seeds that an experiment's options ask for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from suite.choices import at_least

if TYPE_CHECKING:
    from suite.train.config import TrainConfig


def asked_recipe(name: str, changes: Sequence[str], iterations: int | None) -> TrainConfig:
    """Return the preset `name` with `changes` and, unless None, its own number of gradient steps.

    Raises:
        ValueError: for a preset, a change or a number that cannot be used.
    """
    from suite.train.overrides import override
    from suite.train.presets import preset

    recipe = override(preset(name), changes)
    if iterations is None:
        return recipe
    at_least("--iterations", iterations, 1)
    return replace(recipe, optimizer=replace(recipe.optimizer, iterations=iterations))


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

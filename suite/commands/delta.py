"""`suite delta`: fit the Delta Action Model to recorded flights."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from suite.common.console import Console
from suite.common.options import Advanced, Command
from tracks.input.ranges import Iterations, Range, Seed


@dataclass(frozen=True)
class Config(Command):
    """Fit the Delta Action Model by gradients through the point mass, or through a quadrotor."""

    flights: tyro.conf.Positional[tuple[Path, ...]]
    """Flight logs, or folders of them, as `suite collect` writes them."""
    out: Path = Path("runs/delta")
    """Folder for the checkpoint delta/, delta.json and table.md."""
    recipe: Advanced[str] = "race"
    """The training recipe whose point mass is corrected."""
    model: Literal["point", "quad"] = "point"
    """What is corrected: the point mass, or the quadrotor of --vehicle with its effects."""
    vehicle: str | None = None
    """The vehicle of --model quad: a shipped name or a vehicle file (.toml)."""
    held_out: Advanced[Annotated[float, Range(0.0, 1.0, above=True, below=True)]] = 0.25
    """Share of the flights that take no part in the fit."""
    iterations: Iterations = 1500
    """Gradient steps."""
    seed: Seed = 0
    """Seed of the network, the split and the batches."""

    LOCKED = ("out",)


def run(config: Config, console: Console) -> dict[str, Any]:
    """Fit, and show the errors on held-out flights next to those of the plain point mass.

    Raises:
        ValueError: for an unknown recipe or logs that cannot be used.
    """
    from suite.delta.fit import FitConfig
    from suite.delta.run import errors, fit_delta, table
    from suite.train.recipes import chosen_model, named_recipe
    from tracks.common.files import plain

    fitting = replace(
        FitConfig(),
        held_out=config.held_out,
        iterations=config.iterations,
        seed=config.seed,
    )
    recipe = chosen_model(named_recipe(config.recipe), config.model, config.vehicle)
    dynamics = recipe.quadrotor or recipe.physics
    result = fit_delta(fitting, dynamics, config.flights, config.out, console)
    console.say(table(result, fitting.horizon_s))
    console.say(f"delta: {config.out / 'delta'}")
    return {"delta": str(config.out / "delta"), **plain(errors(result))}

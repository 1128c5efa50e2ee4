"""The command `suite delta`: fit a Delta Action Model to recorded flights."""

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
    """The corrected dynamics: the point mass, or the quadrotor of --vehicle with its effects."""
    vehicle: str | None = None
    """The vehicle of --model quad: a shipped name or a vehicle file (.toml)."""
    held_out: Advanced[Annotated[float, Range(0.0, 1.0, above=True, below=True)]] = 0.25
    """Share of the flights that are held out: the fit does not use them."""
    accept: Advanced[tuple[str, ...]] = ()
    """Continue in spite of these faults of the logs; the names are those that suite check
    prints."""
    iterations: Iterations = 1500
    """Number of gradient steps."""
    seed: Seed = 0
    """Seed of the network, the split of the flights and the batches."""

    LOCKED = ("out",)


def run(config: Config, console: Console) -> dict[str, Any]:
    """Fit the model, and show the errors on held-out flights with the model and without it."""
    from eval.logs.faults.check import CheckContext
    from eval.logs.faults.checked import COMPENSATED, read_checked
    from suite.delta.fit import FitConfig
    from suite.delta.run import errors_grid, fit_delta
    from suite.train.recipes import named_recipe, with_model
    from tracks.common.files import plain
    from tracks.common.grid import markdown

    fitting = replace(
        FitConfig(), held_out=config.held_out, iterations=config.iterations, seed=config.seed
    )
    recipe = with_model(named_recipe(config.recipe), config.model, config.vehicle)
    dynamics = recipe.quadrotor or recipe.physics
    context = CheckContext(recipe.quadrotor.vehicle if recipe.quadrotor else None)
    flights = read_checked(config.flights, context, [*config.accept, *COMPENSATED])
    result = fit_delta(fitting, dynamics, flights, config.out, console, config)
    errors = plain(result.errors)
    console.say(markdown(errors_grid({"horizon_s": fitting.horizon_s, **errors})))
    console.say(f"delta: {config.out / 'delta'}")
    return {"delta": str(config.out / "delta"), **errors}

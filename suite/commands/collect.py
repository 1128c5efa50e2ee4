"""`suite collect`: record flights for fitting the Delta Action Model or for a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from suite.common.console import Console


@dataclass(frozen=True)
class Config:
    """Fly a policy and record every flight as a log (Parquet)."""

    policy: str = ""
    """A shipped policy's name, a checkpoint's folder, or a policy file; by default the shipped
    policy."""
    track: str = "all"
    """As in suite eval."""
    difficulty: str = "0,3"
    """As in suite eval."""
    trials: int = 5
    """Flights on every track at every level."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""
    world: str = "mujoco"
    """As in suite eval."""
    seed: int = 100_000
    """Seed of the first trial; by default far from those that suite eval flies."""
    out: Path = Path("runs/flights")
    """Folder for the flights, and for flights.json, which lists them."""
    trust: bool = False
    """Also load policy files that can run code on this machine."""
    json: bool = False
    """Print one JSON object to standard output and nothing else."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Record as `config` says; flights that are there already are not flown again.

    Raises:
        ValueError: for anything that cannot be used, before the first flight.
    """
    from suite.judging.collect import Collection, collect

    collection = Collection(
        policy=config.policy,
        track=config.track,
        difficulty=config.difficulty,
        trials=config.trials,
        vehicle=config.vehicle,
        world=config.world,
        seed=config.seed,
        trust=config.trust,
    )
    return collect(collection, config.out, console)

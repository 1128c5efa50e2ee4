"""The command `suite collect`: record simulated flights as logs, for a diagnosis or a fit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from suite.common.console import Console
from suite.common.options import Command
from suite.common.work import WorkersOption, read_workers_option
from suite.judging.requests import Collection


@dataclass(frozen=True)
class Config(Command):
    """Fly a policy and record every flight as a log (Parquet)."""

    flown: Collection = Collection()
    """The flights: policy, tracks, vehicle and simulator."""
    out: Path = Path("runs/flights")
    """Folder for the flights, and for flights.json, which lists them. If the simulator differs from
    the vehicle file, vehicle_as_flown.toml describes the flights."""
    workers: WorkersOption = None
    """Share the flights among N processes of this machine, or on the cluster at HOST:PORT, whose
    owner can run code here. Without it as many cores are used as shorten the work."""

    LOCKED = ("out",)


def run(config: Config, console: Console) -> dict[str, Any]:
    """Record the flights; existing logs of an interrupted call are kept."""
    from suite.judging.collect import collect

    return collect(config.flown, config.out, console, read_workers_option(config.workers))

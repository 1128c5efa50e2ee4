"""`suite collect`: record flights for fitting the Delta Action Model or for a diagnosis."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from suite.common.console import Console
from suite.common.options import Command
from suite.common.work import WorkersOption, workers_given
from suite.judging.requests import Collection


@dataclass(frozen=True)
class Config(Command):
    """Fly a policy and record every flight as a log (Parquet)."""

    flown: Collection = Collection()
    """What is flown."""
    out: Path = Path("runs/flights")
    """Folder for the flights, and for flights.json, which lists them."""
    workers: WorkersOption = None
    """Share the flights among N processes of this machine, or on the cluster at HOST:PORT, whose
    owner can run code here. Without it as many cores are used as give a gain."""

    LOCKED = ("out",)


def run(config: Config, console: Console) -> dict[str, Any]:
    """Record as `config` says; flights that are there already are not flown again.

    Raises:
        ValueError: for anything that cannot be used, before the first flight.
    """
    from suite.judging.collect import collect

    return collect(config.flown, config.out, console, workers_given(config.workers))

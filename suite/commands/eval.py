"""The command `suite eval`: judge policies in a simulator, on tracks that no training uses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from suite.common.console import Console
from suite.common.options import Command
from suite.common.work import WorkersOption, read_workers_option
from suite.judging.requests import Evaluation


@dataclass(frozen=True)
class Config(Command):
    """Fly trials and write tables of the results; further policies are compared with the first."""

    flown: Evaluation = Evaluation()
    """The flights: policies, tracks, vehicle and simulator."""
    out: Path = Path("runs/eval")
    """Folder for trials.parquet, table.md, summary.json and run.json."""
    workers: WorkersOption = None
    """Share the trials among N processes of this machine, or on the cluster at HOST:PORT, whose
    owner can run code here. Without it as many cores are used as shorten the work."""

    LOCKED = ("out",)


def run(config: Config, console: Console) -> dict[str, Any]:
    """Judge the policies, and write the tables."""
    from suite.judging.evaluate import evaluate

    return evaluate(config.flown, config.out, console, read_workers_option(config.workers))

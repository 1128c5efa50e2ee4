"""`suite compare`: evaluations that were made apart, compared as a publication wants it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from suite.common.console import Console
from suite.common.options import Command


@dataclass(frozen=True)
class Config(Command):
    """Compare the success rates of evaluations on the same trials; each RUN is a suite eval --out.

    Each run is compared with the first one; with --seeds all are training seeds of one method, and
    with --against two methods are compared over their training seeds.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Folders (--out) of suite eval, two or more."""
    against: tuple[Path, ...] = ()
    """Folders with training seeds of another method; the differences are to it."""
    seeds: bool = False
    """Take the runs as training seeds of one method: print mean, spread and interval."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Compare and print a sentence each.

    Raises:
        ValueError: for too few runs, or runs under other conditions.
    """
    from suite.judging.comparing import paired, read_runs, seeds_of

    runs = [run for folder in config.runs for run in read_runs(folder)]
    others = [run for folder in config.against for run in read_runs(folder)]
    if len(runs) < 2 and not (runs and others):
        raise ValueError("RUN is given less than twice; give two folders or more of suite eval")
    if config.seeds or (others and max(len(runs), len(others)) > 1):
        found = [seeds_of(runs, others)]
    else:
        found = [paired(runs[0], other) for other in (others or runs[1:])]
    for each in found:
        console.say(each["sentence"])
    return {"comparisons": found}

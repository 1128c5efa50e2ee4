"""The command `suite compare`: compare the success rates of separate evaluations, with a test."""

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
    """Folders (--out) of suite eval, two or more; with --against one is enough."""
    against: tuple[Path, ...] = ()
    """Folders with training seeds of another method, whose success rate is subtracted."""
    seeds: bool = False
    """Treat the runs as training seeds of one method: print mean, spread and interval."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Compare the runs and print a sentence about each comparison.

    With several runs on one side of --against, the means over the training seeds are compared.
    """
    from suite.judging.comparing import (
        compare_runs,
        compare_seeds,
        policy_notes,
        read_runs,
        seed_notes,
        version_notes,
        without_folders,
    )

    seen = set[Path]()
    for folder in (*config.runs, *config.against):
        if folder.resolve() in seen:
            raise ValueError(f"{folder} is given twice; give each run once")
        seen.add(folder.resolve())
    runs, others = (
        [without_folders(run) for folder in folders for run in read_runs(folder)]
        for folders in (config.runs, config.against)
    )
    if len(runs) < 2 and not (runs and others):
        raise ValueError(
            "a comparison needs the results of two policies or more; give the --out folders of "
            f"suite eval, such as suite compare runs/a runs/b (given: {len(runs) + len(others)})"
        )
    if config.seeds or (others and max(len(runs), len(others)) > 1):
        comparisons = [compare_seeds(runs, others)]
        notes = [note for group in (runs, others) for note in seed_notes(group)]
    else:
        comparisons = [compare_runs(runs[0], other) for other in (others or runs[1:])]
        notes = []
    notes += [*version_notes([*runs, *others]), *policy_notes(runs, others)]
    for note in notes:
        console.note(note)
    for comparison in comparisons:
        console.say(comparison["sentence"])
    return {"comparisons": comparisons, "notes": notes}

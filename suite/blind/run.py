"""Run the diagnosis on the cases of a set."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from suite.blind.make import load_manifest
from suite.common.console import Console
from suite.common.errors import INTERRUPTED, WorkFailed
from suite.common.running.apart import Job
from suite.common.work import all_done
from tracks.common.files import write_json
from tracks.common.work import Workers

Diagnose = Callable[[Sequence[Path], Path, Path], None]
"""Takes flight logs, the vehicle file and an output folder, and writes `diagnosis.json` there."""
TIMED, FAILED = "seconds.json", "error.json"
"""File in the folder of a diagnosed case: the time of the diagnosis, or why it failed."""
CRASHED = 500
"""Longest error text that is stored, in characters."""


def run_set(
    out: Path,
    diagnose: Diagnose,
    console: Console,
    into: Path | None = None,
    workers: Workers | None = None,
) -> int:
    """Diagnose every case without a result, and return the number of results.

    Results go to `into` (OUT/results if not given), one folder a case, with `seconds.json`
    next to `diagnosis.json`. A case that fails gets `error.json` and is tried again next time.
    `workers` diagnose several at once; None is this process.
    """
    results = into or out / "results"
    names = list(load_manifest(out).cases)
    jobs = [
        Job(name, results / name, out / "cases" / name)
        for name in names
        if not (results / name / TIMED).is_file()
    ]
    with console.progress("diagnoses", len(names)) as update:
        if workers is None or workers == 1:
            for done, job in enumerate(jobs, len(names) - len(jobs)):
                _one(diagnose, job, console)
                update(done + 1, job.task)
        else:
            all_done(partial(_one, diagnose), jobs, workers, console, "diagnoses")
    return sum((results / name / TIMED).is_file() for name in names)


def _one(diagnose: Diagnose, job: Job, console: Console) -> None:
    del console
    case, folder = job.reads, job.folder
    assert case is not None
    flights = sorted(case.glob("flight_*.parquet"), key=lambda path: int(path.stem.split("_")[1]))
    error = folder / FAILED
    start = time.perf_counter()
    try:
        diagnose(flights, case / "vehicle.toml", folder)
        json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    # Any failure is a result of this case; the other cases continue.
    except Exception as reason:
        write_json(error, {"error": f"{type(reason).__name__}: {reason}"[:CRASHED]})
        return
    error.unlink(missing_ok=True)
    write_json(folder / TIMED, {"seconds": time.perf_counter() - start})


def by_command(flights: Sequence[Path], vehicle: Path, out: Path) -> None:
    """Diagnose by `suite diagnose`, in this process.

    Raises:
        WorkFailed: if the command ends with another code than 0.
    """
    import contextlib
    import io

    from suite.cli import main

    said = io.StringIO()
    args = [*map(str, flights), "--vehicle", str(vehicle), "--out", str(out)]
    # Hidden effects are as small as flights can detect, often below the thresholds of relevance.
    args += ["--relevance", "0", "0", "0"]
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = main(["diagnose", *args])
    if code == INTERRUPTED:
        raise KeyboardInterrupt
    if code:
        last = said.getvalue().strip().splitlines()[-1:]
        raise WorkFailed(f"suite diagnose ended with code {code}: {' '.join(last)}")

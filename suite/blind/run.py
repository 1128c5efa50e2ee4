"""Run the diagnosis on the blind cases of a set, and store its results next to them."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from suite.blind.make import RESULTS, load_manifest
from suite.common.console import Console
from suite.common.errors import INTERRUPTED, WorkFailed
from suite.common.running.remote import Job
from suite.common.work import do_jobs
from tracks.common.files import write_json
from tracks.common.work import Workers

Diagnose = Callable[[Sequence[Path], Path, Path], None]
"""Function (flight logs, vehicle file, output folder) that writes `diagnosis.json`."""
TIMED, FAILED = "seconds.json", "error.json"
"""Names of two files. A case has the first one, the time of the diagnosis, or the second one, the
reason why the diagnosis failed."""
LONGEST_ERROR = 500
"""Largest number of characters of a stored reason."""


def run_set(out: Path, diagnose: Diagnose, console: Console, workers: Workers | None = None) -> int:
    """Diagnose every case without a result, and return how many cases have a result then.

    The result of a case is the folder OUT/results/CASE with `diagnosis.json` and `seconds.json`. If
    a diagnosis fails, the folder has `error.json`, and the next run tries the case again. Without
    workers, this process diagnoses all cases.
    """
    results, names = out / RESULTS, list(load_manifest(out).cases)
    jobs = [
        Job(name, results / name, out / "cases" / name)
        for name in names
        if not (results / name / TIMED).is_file()
    ]
    if workers is None or workers == 1:
        before = len(names) - len(jobs)
        with console.progress("diagnoses", len(names), begun=before) as update:
            for done, job in enumerate(jobs, before + 1):
                _diagnose_case(diagnose, job, console)
                update(done, job.task)
    else:
        do_jobs(partial(_diagnose_case, diagnose), jobs, workers, console, "diagnoses")
    return sum((results / name / TIMED).is_file() for name in names)


def _diagnose_case(diagnose: Diagnose, job: Job, console: Console) -> None:
    """Diagnose the case in the folder `job.reads`, and write the result to `job.folder`."""
    del console  # a job gets one, but the diagnosis prints nothing
    case, folder = job.reads, job.folder
    assert case is not None
    flights = sorted(case.glob("flight_*.parquet"), key=lambda path: int(path.stem.split("_")[1]))
    error = folder / FAILED
    start = time.perf_counter()
    try:
        diagnose(flights, case / "vehicle.toml", folder)
        json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    # Any error is the result of this case; the other cases continue.
    except Exception as reason:
        write_json(error, {"error": f"{type(reason).__name__}: {reason}"[:LONGEST_ERROR]})
        return
    error.unlink(missing_ok=True)
    write_json(folder / TIMED, {"seconds": time.perf_counter() - start})


def diagnose_by_command(flights: Sequence[Path], vehicle: Path, out: Path) -> None:
    """Run the command `suite diagnose` in this process; a function of the type `Diagnose`.

    Raises:
        WorkFailed: if the command ends with another code than 0.
    """
    import contextlib
    import io

    from suite.cli import main

    output = io.StringIO()
    args = [*map(str, flights), "--vehicle", str(vehicle), "--out", str(out)]
    # Hidden effects are just detectable. The thresholds of practical relevance would often leave
    # out such small effects.
    args += ["--relevance", "0", "0", "0"]
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        code = main(["diagnose", *args])
    if code == INTERRUPTED:
        raise KeyboardInterrupt
    if code:
        last_line = output.getvalue().strip().splitlines()[-1:]
        raise WorkFailed(f"suite diagnose ended with code {code}: {' '.join(last_line)}")

"""Run a long command in stages; each has a folder, and a finished stage is not repeated.

The same command with the same configuration continues at the first unfinished stage. Before it
starts, it prints an estimate of the time and the memory of the remaining work.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from suite.common.console import Console, duration, size
from suite.common.provenance import refuse_other_run, write_run_record
from tracks.common.files import plain, write_json
from tracks.common.provenance import differences, first_changes, git_commit, stamp
from tracks.input.reading import read_json

MARK = "stage.json"
"""Name of the file in a stage's folder that marks the stage as finished; written last."""
SCHEMA = 1
"""Version of that file."""


def claim(out: Path, config: Any, seed: int) -> None:
    """Make `out` the folder of a run of `config`, or check that it is this already.

    Raises:
        ValueError: if `out` is in the folder of a policy, or has a run of another kind or
            configuration (with the differences).
    """
    refuse_other_run(out, config)
    refuse_other_options(out, config)
    if not (out / "run.json").is_file():
        write_run_record(out, config, seed)


def refuse_other_options(out: Path, config: Any) -> None:
    """Refuse a folder with a run of other options than `config`, so that no result is overwritten.

    Raises:
        ValueError: with the differences, except in the name of the folder and in --json.
    """
    if changes := changed_options(out, config):
        raise ValueError(
            f"{out} holds a run of another configuration ({first_changes(changes)}); give another "
            "--out, or move the folder away to start over"
        )


def changed_options(out: Path, config: Any) -> list[str]:
    """Return the differences between the options of the run in `out`, if any, and `config`.

    The name of the folder and --json do not count.

    Raises:
        ValueError: where the record of the run cannot be read.
    """
    path = out / "run.json"
    if not path.is_file():
        return []
    try:
        stored = dict(read_json(path)["config"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not the record of a run ({error}); move it away") from error
    unchanged = {name: stored.get(name) for name in ("out", "json")}
    return differences({**stored, **unchanged}, {**plain(config), **unchanged})


@dataclass(frozen=True)
class Stage:
    """One stage of a run."""

    name: str
    """Name of the stage, and of its folder within that of the run."""
    title: str
    """Description for the console."""
    estimate: Estimate
    work: Callable[[Path], Any]
    """Function that does the stage in the given folder. It must continue an interrupted call."""
    show_result: Callable[[Path], None] = lambda folder: None
    """Function that prints the result of the finished stage in the given folder."""


def run_stages(
    out: Path, stages: Sequence[Stage], console: Console, title: str
) -> dict[str, float]:
    """Do the unfinished stages one after the other, each in its folder.

    The console shows the estimate of the remaining work, and each stage.

    Returns:
        The time that each stage took, by its name [s].
    """
    remaining = [stage.estimate for stage in stages if not is_done(out / stage.name)]
    seconds = sum(estimate.seconds for estimate in remaining)
    if seconds:
        memory_bytes = max(estimate.memory_bytes for estimate in remaining)
        announce(console, title, Estimate(seconds, memory_bytes))
    durations_s = {}
    for number, stage in enumerate(stages, 1):
        folder, count = out / stage.name, f"[{number}/{len(stages)}]"
        durations_s[stage.name] = _run_stage(stage, folder, count, console)
        stage.show_result(folder)
    return durations_s


def is_done(folder: Path) -> bool:
    """Return whether the stage in `folder` is finished."""
    return (folder / MARK).is_file()


def stage_commits(out: Path, names: Iterable[str]) -> list[str]:
    """Return the commits of the code that did the finished stages `names` in `out`, each once."""
    marks = (read_json(out / name / MARK) for name in names)
    return sorted({mark.get("git_commit") or "unknown" for mark in marks})


def _run_stage(stage: Stage, folder: Path, number: str, console: Console) -> float:
    """Do a stage unless it is finished, and return the time that it took [s].

    `number` is its place among all stages as text, such as "[2/5]".
    """
    if is_done(folder):
        console.note(f"{number} {stage.title}: done before, in {folder}")
        try:
            mark = read_json(folder / MARK)
            if mark.get("git_commit") != git_commit():
                console.note(f"warning: by the code of commit {mark.get('git_commit')}")
            return float(mark["seconds"])
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{folder / MARK}: not the mark of a finished stage ({error}); remove the file to "
                "do the stage again"
            ) from error
    console.note(f"{number} {stage.title}")
    started = time.monotonic()
    stage.work(folder)
    seconds = time.monotonic() - started
    # Written last, when all other files are on the disk.
    mark = {**stamp(SCHEMA, None), "stage": stage.title, "seconds": seconds}
    write_json(folder / MARK, mark)
    console.note(f"{number} took {duration(seconds)}")
    return seconds


@dataclass(frozen=True)
class Estimate:
    """Time and memory of a piece of work, within a factor of about two."""

    seconds: float
    memory_bytes: float
    """Memory at its peak [bytes]."""


def announce(console: Console, title: str, estimate: Estimate) -> None:
    """Print the estimate of a piece of work, and a warning if it exceeds the free memory."""
    free = psutil.virtual_memory().available
    need = size(estimate.memory_bytes)
    console.note(f"{title}: about {duration(estimate.seconds)} and {need} of memory")
    if estimate.memory_bytes > free:
        console.note(f"warning: only {size(free)} of memory is free; expect it to fail or to swap")

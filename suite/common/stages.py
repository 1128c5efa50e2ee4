"""Stages of a run, each in its own folder: done once, then reused with the same configuration.

Time and memory of the work are estimated and printed before it starts.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from suite.common.console import Console, duration, size
from suite.common.provenance import write_run_record
from tracks.common.files import plain, write_json
from tracks.input.reading import read_json

MARK = "stage.json"
"""Name of the file that marks a finished stage; written last."""


def claim(out: Path, config: Any, seed: int) -> None:
    """Make `out` the folder of a run of `config`, or check that it is.

    Raises:
        ValueError: if `out` has a run of another configuration, with the differences.
    """
    path = out / "run.json"
    if not path.is_file():
        write_run_record(out, config, seed)
        return
    try:
        theirs = read_json(path)["config"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not the record of a run ({error}); move it away") from error
    changes = differences(theirs, plain(config))
    if changes:
        raise ValueError(
            f"{out} holds a run of another configuration ({first_of(changes)}); give another "
            "--out, or move the folder away to start over"
        )


def differences(theirs: Any, ours: Any, name: str = "") -> list[str]:
    """Return the differences of two plain values, as "name is X there, Y here"."""
    if isinstance(theirs, Mapping) and isinstance(ours, Mapping):
        found = []
        for key in dict.fromkeys([*ours, *theirs]):
            below = f"{name}.{key}" if name else str(key)
            found += differences(theirs.get(key), ours.get(key), below)
        return found
    return [] if theirs == ours else [f"{name} is {theirs!r} there, {ours!r} here"]


def first_of(changes: Sequence[str]) -> str:
    """Return the first four changes and the number of further ones, for a message."""
    more = f"; and {len(changes) - 4} more" if changes[4:] else ""
    return "; ".join(changes[:4]) + more


@dataclass(frozen=True)
class Stage:
    """One stage of a run."""

    name: str
    """Name of its folder in the run's folder."""
    words: str
    """Description for the console."""
    needs: Estimate
    """Time and memory."""
    work: Callable[[Path], Any]
    """Called with the folder; must continue an interrupted earlier call."""
    tell: Callable[[Path], None] = lambda folder: None
    """Called with the folder of every finished stage, to print its result."""


def do_stages(out: Path, stages: Sequence[Stage], console: Console, what: str) -> dict[str, float]:
    """Do the unfinished stages one after the other, each in its folder.

    Args:
        out: the run's folder.
        stages: all of the run's, in order.
        console: shows the estimate of the remaining work, and each stage.
        what: short description of the run.

    Returns:
        The time that each stage took, by its name [s].
    """
    left = [stage.needs for stage in stages if not is_done(out / stage.name)]
    seconds = sum(need.seconds for need in left)
    if seconds:
        announce(console, what, Estimate(seconds, max(need.memory_bytes for need in left)))
    took = {}
    for number, stage in enumerate(stages, 1):
        took[stage.name] = _do(stage, out / stage.name, f"[{number}/{len(stages)}]", console)
        stage.tell(out / stage.name)
    return took


def is_done(folder: Path) -> bool:
    """Return whether the stage in `folder` is finished."""
    return (folder / MARK).is_file()


def _do(stage: Stage, folder: Path, number: str, console: Console) -> float:
    """Do a stage unless it is finished, and return the time that it took [s]."""
    if is_done(folder):
        console.note(f"{number} {stage.words}: done before, in {folder}")
        try:
            return float(read_json(folder / MARK)["seconds"])
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{folder / MARK}: not the mark of a finished stage ({error}); remove the file to "
                "do the stage again"
            ) from error
    console.note(f"{number} {stage.words}")
    started = time.monotonic()
    stage.work(folder)
    seconds = time.monotonic() - started
    # Written last, when all other files are on the disk.
    write_json(folder / MARK, {"stage": stage.words, "seconds": seconds})
    console.note(f"{number} took {duration(seconds)}")
    return seconds


@dataclass(frozen=True)
class Estimate:
    """Time and memory of a piece of work, within a factor of about two."""

    seconds: float
    """Time [s]."""
    memory_bytes: float
    """Memory at its peak [bytes]."""


def available_memory_bytes() -> int:
    """Return the memory that is available without swapping, or all memory if unknown [bytes]."""
    try:
        text = Path("/proc/meminfo").read_text(encoding="ascii")
        return 1024 * int(text.split("MemAvailable:")[1].split()[0])
    except (OSError, IndexError):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def announce(console: Console, what: str, estimate: Estimate) -> None:
    """Print the estimate of `what`, and a warning if it exceeds the free memory."""
    free = available_memory_bytes()
    need = size(estimate.memory_bytes)
    console.note(f"{what}: about {duration(estimate.seconds)} and {need} of memory")
    if estimate.memory_bytes > free:
        console.note(f"warning: only {size(free)} of memory is free; expect it to fail or to swap")

"""Stages in folders of their own: done once, found again, refused for another configuration.

Before a stage starts it is said how long it will take and how much memory it needs.
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
"""Name of the file that says that a stage's folder is finished; written last."""


def claim(out: Path, config: Any, seed: int) -> None:
    """Make `out` the folder of a run of `config`, or find that it is.

    Raises:
        ValueError: where `out` holds a run of another configuration, saying what differs.
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
    """Return what differs between two plain values, as "name is X there, Y here"."""
    if isinstance(theirs, Mapping) and isinstance(ours, Mapping):
        found = []
        for key in dict.fromkeys([*ours, *theirs]):
            below = f"{name}.{key}" if name else str(key)
            found += differences(theirs.get(key), ours.get(key), below)
        return found
    return [] if theirs == ours else [f"{name} is {theirs!r} there, {ours!r} here"]


def first_of(changes: Sequence[str]) -> str:
    """Return the first four changes, and how many more there are, for a message."""
    more = f"; and {len(changes) - 4} more" if changes[4:] else ""
    return "; ".join(changes[:4]) + more


@dataclass(frozen=True)
class Stage:
    """One stage of a run."""

    name: str
    """Of its folder below the run's."""
    words: str
    """What it does, for people."""
    needs: Estimate
    """Time and memory."""
    work: Callable[[Path], Any]
    """Called with the folder; it must continue an interrupted earlier call."""
    tell: Callable[[Path], None] = lambda folder: None
    """Called with the folder of the finished stage, also of one found again, to say what came."""


def do_stages(out: Path, stages: Sequence[Stage], console: Console, what: str) -> dict[str, float]:
    """Do the stages that are not finished, each in its folder, one after the other.

    Args:
        out: the run's folder.
        stages: all of the run's, in order.
        console: shows what is done, after about how long all that is left will take.
        what: the run is, in a few words.

    Returns:
        How long each stage took when it was done, by its name [s].
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
    """Say whether the stage in `folder` is finished already."""
    return (folder / MARK).is_file()


def _do(stage: Stage, folder: Path, number: str, console: Console) -> float:
    """Do a stage unless it is finished, and return how long it took [s]."""
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
    # Written last: what it vouches for is on the disk.
    write_json(folder / MARK, {"stage": stage.words, "seconds": seconds})
    console.note(f"{number} took {duration(seconds)}")
    return seconds


@dataclass(frozen=True)
class Estimate:
    """What a piece of work will need; a guess within a factor of about two."""

    seconds: float
    """Time [s]."""
    memory_bytes: float
    """Memory at its peak [bytes]."""


def available_memory_bytes() -> int:
    """Return how much memory can be had without swapping [bytes]; all of it where unknown."""
    try:
        text = Path("/proc/meminfo").read_text(encoding="ascii")
        return 1024 * int(text.split("MemAvailable:")[1].split()[0])
    except (OSError, IndexError):
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def announce(console: Console, what: str, estimate: Estimate) -> None:
    """Say `estimate` of `what`, and warn where the memory is not there."""
    free = available_memory_bytes()
    need = size(estimate.memory_bytes)
    console.note(f"{what}: about {duration(estimate.seconds)} and {need} of memory")
    if estimate.memory_bytes > free:
        console.note(f"warning: only {size(free)} of memory is free; expect it to fail or to swap")

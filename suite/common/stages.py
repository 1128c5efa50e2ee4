"""Stages in folders of their own: done once, found again, refused for another configuration."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from suite.common.console import Console, duration
from suite.common.provenance import write_run_record
from tracks.common.files import plain, write_json

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
        theirs = json.loads(path.read_text(encoding="utf-8"))["config"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not the record of a run ({error}); move it away") from error
    changes = differences(theirs, plain(config))
    if changes:
        shown = "; ".join(changes[:4]) + (f"; and {len(changes) - 4} more" if changes[4:] else "")
        raise ValueError(
            f"{out} holds a run of another configuration ({shown}); give another --out, or move "
            "the folder away to start over"
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


class Stages:
    """The stages of a run, one after the other."""

    def __init__(self, out: Path, console: Console, total: int) -> None:
        """Begin with none done; `total` is how many there will be."""
        self.out, self.console, self.total = out, console, total
        self.seconds: dict[str, float] = {}
        """How long each stage took when it was done, by its folder's name [s]."""

    def is_done(self, name: str) -> bool:
        """Say whether a stage is finished already."""
        return (self.out / name / MARK).is_file()

    def do(self, name: str, words: str, work: Callable[[Path], Any]) -> Path:
        """Do a stage in its folder unless it is finished, and return the folder.

        Args:
            name: of the folder below the run's.
            words: what the stage does, for people.
            work: called with the folder; it must go on where an earlier call was cut off.
        """
        folder = self.out / name
        number = f"[{len(self.seconds) + 1}/{self.total}]"
        if self.is_done(name):
            found = json.loads((folder / MARK).read_text(encoding="utf-8"))
            self.seconds[name] = float(found["seconds"])
            self.console.note(f"{number} {words}: done before, in {folder}")
            return folder
        self.console.note(f"{number} {words}")
        started = time.monotonic()
        work(folder)
        self.seconds[name] = time.monotonic() - started
        # Written last: what it vouches for is on the disk.
        write_json(folder / MARK, {"stage": words, "seconds": self.seconds[name]})
        self.console.note(f"{number} took {duration(self.seconds[name])}")
        return folder

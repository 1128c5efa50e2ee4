"""Provenance of files: the suite's version, git commit and seed, which every written file holds.

Also the differences between what an earlier run recorded and what this one has.

The build of the package reads `VERSION` from this file.
"""

from __future__ import annotations

import functools
import hashlib
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tracks.input.ranges import shown

VERSION = "0.1.0"
"""Version of the suite."""
_ROOT = Path(__file__).resolve().parents[2]


@functools.cache
def git_commit() -> str | None:
    """Return the git commit of this code, or None where it is unknown (a copy without history).

    If tracked files differ from the commit, "-dirty-" and 8 hex digits of a digest of the
    differences follow, so that two states of the code do not have the same name. In a checkout, git
    reports the commit. An installed wheel contains the commit from which it was built. A git
    repository that only contains the installed package, such as a user's project, is ignored.
    """
    built_from = Path(__file__).with_name("built_from.txt")
    if built_from.is_file():
        return built_from.read_text(encoding="utf-8").strip() or None
    if not (_ROOT / ".git").exists():
        return None
    try:
        commit = _git(_ROOT, "rev-parse", "HEAD").decode().strip()
        changes = _git(_ROOT, "diff", "HEAD", "--binary", "--no-ext-diff", "--no-textconv")
    except (OSError, subprocess.SubprocessError):
        return None
    return f"{commit}-dirty-{hashlib.sha256(changes).hexdigest()[:8]}" if changes else commit


def _git(root: Path, *arguments: str) -> bytes:
    command = ["git", "-C", str(root), *arguments]
    return subprocess.run(command, capture_output=True, timeout=10, check=True).stdout


def stamp(schema: int, seed: int | None) -> dict[str, Any]:
    """Return the keys `schema`, `suite_version`, `git_commit` and `seed` for a file's header."""
    return {"schema": schema, "suite_version": VERSION, "git_commit": git_commit(), "seed": seed}


def stamp_text(header: Mapping[str, Any]) -> str:
    """Return the keys of `stamp` that have a value as one line, for a comment in a text file."""
    return "; ".join(f"{key}: {value}" for key, value in header.items() if value is not None)


def differences(stored: Any, new: Any, name: str = "") -> list[str]:
    """Return the differences of two plain values (as in JSON), as "name is X there, Y here".

    `stored` is of an earlier run ("there"), `new` of this one ("here"). The names of nested values
    are appended to `name`.
    """
    there, here = _by_name(stored), _by_name(new)
    if isinstance(there, Mapping) and isinstance(here, Mapping):
        changes = []
        for key in dict.fromkeys([*here, *there]):
            path = f"{name}.{key}" if name else str(key)
            changes += differences(there.get(key), here.get(key), path)
        if changes or isinstance(stored, Mapping):
            return changes
    return [] if stored == new else [f"{name} is {shown(stored)} there, {shown(new)} here"]


def _by_name(value: Any) -> Any:
    """Return a list of records by their numbers, and one of changes "name=value" by their names."""
    if isinstance(value, list) and all(isinstance(one, Mapping) for one in value):
        return {number: one for number, one in enumerate(value, 1)}
    if isinstance(value, list) and all(isinstance(one, str) and "=" in one for one in value):
        return dict(one.split("=", 1) for one in value)
    return value


def first_changes(changes: Sequence[str]) -> str:
    """Return the first four changes and the number of further ones, for a message."""
    more = f"; and {len(changes) - 4} more" if changes[4:] else ""
    return "; ".join(changes[:4]) + more

"""The error for a name that is in no table."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

LONGEST = 80
"""Characters of a name that are looked at, and shown; a file's key may be of megabytes."""


def closest(name: str, allowed: Iterable[str]) -> str | None:
    """Return the entry of `allowed` that `name` was probably meant to be, or None."""
    lowered = {entry.lower(): entry for entry in allowed}
    match = difflib.get_close_matches(name[:LONGEST].lower(), lowered, n=1, cutoff=0.6)
    return lowered[match[0]] if match else None


def unknown_name(kind: str, name: str, allowed: Iterable[str]) -> ValueError:
    """Return (not raise) the error for `name` where only `allowed` names of `kind` exist.

    The message gives the name, the nearest one or those that hold it, and the whole list.
    """
    allowed = list(allowed)
    near = [guess] if (guess := closest(name, allowed)) else _holding(name, allowed)
    meant = f" Did you mean {', '.join(map(repr, near))}?" if near else ""
    return ValueError(f"unknown {kind} {name[:LONGEST]!r}.{meant} Known: {', '.join(allowed)}.")


def _holding(name: str, allowed: list[str]) -> list[str]:
    """Return those of `allowed` that hold `name` as a part, where they are few."""
    found = [entry for entry in allowed if len(name) > 2 and name.lower() in entry.lower()]
    return found if len(found) < 5 else []

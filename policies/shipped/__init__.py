"""The policies that the suite ships: one folder each, with a checkpoint and a card.md."""

from __future__ import annotations

import os
from pathlib import Path

DEFAULT = "race"
"""Name of the default policy."""

_HERE = Path(__file__).resolve().parent
"""Folder of the shipped policies."""


def names() -> list[str]:
    """Return the names of the shipped policies, sorted."""
    return sorted(path.parent.name for path in _HERE.glob("*/config.json"))


def locate(name_or_path: str | Path) -> Path:
    """Return a shipped policy's folder for its name; any other text is returned as a path."""
    here = _HERE if str(name_or_path) in names() else Path()
    return here / os.path.expanduser(name_or_path)

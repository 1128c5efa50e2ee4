"""Lists of tracks and levels from the text of an option."""

from __future__ import annotations

import re

LEVELS = tuple(range(10))
"""The difficulty levels."""


def parse_levels(text: str) -> list[int]:
    """Return the levels of "3", "0,3,9", "0-3", "0,5-9" or "all", in the order given.

    Raises:
        ValueError: for any other text, and for a level that is not 0 to 9.
    """
    if text.strip() == "all":
        return list(LEVELS)
    levels: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", part)
        if not match:
            raise ValueError(
                f"--difficulty {text!r}: {part!r} is no level; give 0 to 9, a list (0,3,9), "
                "a range (0-3), or all"
            )
        first, last = int(match[1]), int(match[2] or match[1])
        for level in (first, last):
            if level not in LEVELS:
                raise ValueError(f"--difficulty {text!r}: level {level} is not 0 to 9")
        if last < first:
            raise ValueError(f"--difficulty {text!r}: the range {part!r} runs backwards")
        levels += range(first, last + 1)
    return list(dict.fromkeys(levels))


def parse_tracks(text: str) -> list[str]:
    """Return the tracks of "all" (the judged families), a name, a file, or a list of them.

    A name that ends in ``.toml`` is a track file; others are families.

    Raises:
        ValueError: for an unknown family, with the most similar one.
    """
    from tracks.families import JUDGED, check_family

    if text.strip() == "all":
        return list(JUDGED)
    names = [part.strip() for part in text.split(",")]
    for name in names:
        if not is_track_file(name):
            check_family(name)
    return list(dict.fromkeys(names))


def is_track_file(name: str) -> bool:
    """Return whether `name` is a track file and not a family."""
    return name.endswith(".toml")

"""Where a file came from: the four keys that every file we write carries."""

from __future__ import annotations

import functools
import subprocess
from pathlib import Path
from typing import Any

from tracks.common.version import VERSION

_ROOT = Path(__file__).resolve().parents[2]


@functools.cache
def git_commit() -> str | None:
    """Return the commit this code comes from, with "-dirty" where tracked files differ from it.

    A checkout is asked through git; a wheel carries the commit it was built from. None where
    neither knows (a copy without history). A repository that merely surrounds the installed
    package is not asked.
    """
    baked = Path(__file__).with_name("built_from.txt")
    if baked.is_file():
        return baked.read_text(encoding="utf-8").strip() or None
    if not (_ROOT / ".git").exists():
        return None
    ask = ["git", "-C", str(_ROOT), "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        answer = subprocess.run(
            [*ask, "--exclude=*"], capture_output=True, text=True, timeout=10, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip() or None


def stamp(schema: int, seed: int | None) -> dict[str, Any]:
    """Return the keys `schema`, `suite_version`, `git_commit` and `seed` for a file's header."""
    return {
        "schema": schema,
        "suite_version": VERSION,
        "git_commit": git_commit(),
        "seed": seed,
    }

"""Provenance of files: the suite's version, and four keys in every file that the suite writes.

The build reads the version here.
"""

from __future__ import annotations

import functools
import hashlib
import subprocess
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parents[2]


@functools.cache
def git_commit() -> str | None:
    """Return the commit of this code, and a digest of later changes.

    Where tracked files differ from the commit, "-dirty-" and 8 digits of their differences follow,
    so that two states of the code never share a name. In a checkout git reports the commit; a wheel
    contains the commit of its build. None where neither exists (a copy without history). A
    repository that merely contains the installed package is ignored.
    """
    baked = Path(__file__).with_name("built_from.txt")
    if baked.is_file():
        return baked.read_text(encoding="utf-8").strip() or None
    if not (_ROOT / ".git").exists():
        return None
    try:
        commit = _git(_ROOT, "rev-parse", "HEAD").decode().strip()
        changes = _git(_ROOT, "diff", "HEAD", "--binary", "--no-ext-diff", "--no-textconv")
    except (OSError, subprocess.SubprocessError):
        return None
    return f"{commit}-dirty-{hashlib.sha256(changes).hexdigest()[:8]}" if changes else commit


def _git(root: Path, *what: str) -> bytes:
    command = ["git", "-C", str(root), *what]
    return subprocess.run(command, capture_output=True, timeout=10, check=True).stdout


def stamp(schema: int, seed: int | None) -> dict[str, Any]:
    """Return the keys `schema`, `suite_version`, `git_commit` and `seed` for a file's header."""
    return {
        "schema": schema,
        "suite_version": VERSION,
        "git_commit": git_commit(),
        "seed": seed,
    }


VERSION = "0.1.0"

"""Provenance of files: the suite's version, git commit and seed, which every written file holds.

The build of the package reads `VERSION` from this file.
"""

from __future__ import annotations

import functools
import hashlib
import subprocess
from pathlib import Path
from typing import Any

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

"""The cache of experiments: a result has a name made from the SHA-256 of its inputs and code.

A change of an input or of the code gives another name, so outdated results are never reused.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tracks.common.files import digest_of
from tracks.common.work import Workers

ROOT = Path(__file__).resolve().parents[3]
"""Folder of the project, which has the four packages."""
NO_RESULT = ("view", "importers", "logs", "faults", "envs", "policy_checks", "input")
"""Names of the folders within packages whose code cannot change a flight."""
FLIES = ("tracks", "policies", "eval")
"""Packages whose code can change a flight."""
MEASURED = {
    "ablation": ("suite/train", "suite/experiments/study"),
    "schemes": ("suite/train", "suite/experiments/study"),
    "four_gates": ("suite/train", "suite/experiments/study"),
    "faults": ("suite/experiments/injected", "eval/importers", "eval/logs", "eval/logs/faults"),
}
"""Page -> folders with the code that it measures, besides `FLIES`."""


@dataclass(frozen=True)
class Workspace:
    """Folders and workers of an experiment."""

    out: Path
    """Folder of the pages."""
    cache: Path
    """Folder of results that all experiments reuse."""
    workers: Workers | None = None
    """Number of processes, or a cluster. None: trainings run one after the other, and flights in as
    many processes as help."""


def digest(value: Any) -> str:
    """Return a digest (16 hex digits) of `value`, which JSON must be able to hold."""
    return digest_of(value)[:16]


@functools.cache
def code_digest(*folders: str) -> str:
    """Return a digest (16 hex digits) of the code in `folders`, without `NO_RESULT` in them.

    Docstrings, comments and layout do not change it. Folders are relative to the project, such as
    "tracks" or "suite/train".
    """
    sha256 = hashlib.sha256()
    for path in _files(folders, "*.py"):
        name = path.relative_to(ROOT)
        tree = _tree_text(ast.parse(path.read_bytes()))
        sha256.update(f"{name.as_posix()}\0{tree}\0".encode())
    return sha256.hexdigest()[:16]


def page_code(page: str) -> str:
    """Return the digest of the code that flies, and of that in `MEASURED`, for a page.

    The shipped TOML files in these folders, such as vehicles and sensors, count as well.
    """
    folders = (*FLIES, *MEASURED.get(page, ()))
    data = [
        [path.relative_to(ROOT).as_posix(), tomllib.loads(path.read_text(encoding="utf-8"))]
        for path in _files(folders, "*.toml")
    ]
    return digest([code_digest(*folders), data])


def _files(folders: Sequence[str], pattern: str) -> Iterator[Path]:
    """Yield the files in `folders`, but not those in folders of `NO_RESULT` within them."""
    for folder in folders:
        for path in sorted((ROOT / folder).rglob(pattern)):
            if not set(path.relative_to(ROOT / folder).parts) & set(NO_RESULT):
                yield path


def _tree_text(node: Any) -> str:
    """Return a syntax tree as text, without docstrings; the same for all versions of Python.

    `ast.dump` also prints fields without a value, whose number grows from version to version.
    """
    match node:
        case list():
            return f"[{','.join(filter(None, map(_tree_text, node)))}]"
        case ast.Expr(ast.Constant(str())):  # a docstring
            return ""
    if not isinstance(node, ast.AST):
        return repr(node)
    fields = [(name, getattr(node, name, None)) for name in node._fields]
    words = [f"{name}={_tree_text(value)}" for name, value in fields if value not in (None, [])]
    return f"{type(node).__name__}({','.join(words)})"

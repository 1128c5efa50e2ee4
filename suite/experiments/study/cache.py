"""The cache of experiments: a result has a name made from the SHA-256 of its inputs and code.

A change of an input or of the code gives another name, so outdated results are never reused.
"""

from __future__ import annotations

import ast
import functools
import hashlib
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from suite.common.provenance import machine, package_versions
from tracks.common.files import digest_of
from tracks.common.names import added_entries
from tracks.common.work import Workers

ROOT = Path(__file__).resolve().parents[3]
"""Folder of the project, which has the four packages."""
NO_RESULT = ("view", "importers", "faults", "envs")
"""Names of the folders within packages whose code cannot change a flight."""
FLIES = ("tracks", "policies", "eval")
"""Packages whose code can change a flight."""


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

    @property
    def at_once(self) -> str:
        """Number of trainings at once, or the address of the cluster."""
        return str(self.workers or 1)


def digest(value: Any) -> str:
    """Return a digest (16 hex digits) of `value`, which JSON must be able to hold."""
    return digest_of(value)[:16]


@functools.cache
def code_digest(*folders: str) -> str:
    """Return a digest (16 hex digits) of the code in `folders`, without `NO_RESULT` in them.

    Docstrings, comments and layout do not change it.

    Args:
        folders: folders of the project, such as "tracks" or "suite/train".
    """
    sha256 = hashlib.sha256()
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            name = path.relative_to(ROOT)
            if not set(path.relative_to(ROOT / folder).parts) & set(NO_RESULT):
                tree = _tree_text(ast.parse(path.read_bytes()))
                sha256.update(f"{name.as_posix()}\0{tree}\0".encode())
    return sha256.hexdigest()[:16]


def _tree_text(node: Any) -> str:
    """Return a syntax tree as text, without docstrings; the same for all versions of Python.

    `ast.dump` also prints fields without a value, whose number grows from version to version.
    """
    if isinstance(node, list):
        return f"[{','.join(_tree_text(item) for item in node if not _is_docstring(item))}]"
    if not isinstance(node, ast.AST):
        return repr(node)
    fields = [(name, getattr(node, name, None)) for name in node._fields]
    words = [f"{name}={_tree_text(value)}" for name, value in fields if value not in (None, [])]
    return f"{type(node).__name__}({','.join(words)})"


def _is_docstring(node: Any) -> bool:
    """Return whether a statement is a bare string."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


@functools.cache
def engines() -> dict[str, str | None]:
    """Return what else affects a result: the processor, versions of packages, and the plugins.

    A plugin is an installed Python package that adds effects, tracks or simulators.
    """
    versions = package_versions()
    names = ("numpy", "scipy", "jax", "jaxlib", "optax", "mujoco", "mujoco-mjx", "torch")
    return {
        "processor": machine()["processor"],
        **{name: versions[name] for name in (*names, "onnxruntime", "rotorpy")},
        "added": added_digest(),
    }


def added_digest() -> str | None:
    """Return a digest (16 hex digits) of the plugins' effects, tracks and simulators, if any."""
    sha256 = hashlib.sha256()
    entries = added_entries()
    for entry in entries:
        sha256.update(f"{entry.group}\0{entry.name}\0{entry.value}\0".encode())
        for path in _sources(entry.module.partition(".")[0]):
            sha256.update(path.name.encode() + b"\0" + path.read_bytes())
    return sha256.hexdigest()[:16] if entries else None


def _sources(module: str) -> list[Path]:
    """Return the source files of a module or a package; none if it is missing."""
    spec = find_spec(module)
    if spec is None:
        return []
    folders = spec.submodule_search_locations or ()
    files = [path for folder in folders for path in Path(folder).rglob("*.py")]
    if not files and spec.origin is not None:
        files = [Path(spec.origin)]
    return sorted(path for path in files if path.is_file())

"""Names in the cache: what is found again must have been made by the same inputs and code."""

from __future__ import annotations

import functools
import hashlib
from pathlib import Path
from typing import Any

from suite.common.provenance import machine, package_versions
from tracks.common.files import to_json

ROOT = Path(__file__).resolve().parents[3]
NO_RESULT = ("view", "importers", "envs")
"""Folders whose code changes no flight."""
LOOP_ROOMS = (
    "tracks",
    "policies",
    "eval",
    "suite/judging",
    "suite/train",
    "suite/delta",
    "suite/loop",
)
"""Code that flies, fits and fine-tunes in a `suite loop`, but for a diagnosis."""


def digest(value: Any) -> str:
    """Return 16 hex digits that stand for `value`, which JSON must be able to hold."""
    return hashlib.sha256(to_json(value).encode()).hexdigest()[:16]


@functools.cache
def code_digest(*rooms: str) -> str:
    """Return 16 hex digits that stand for the code of `rooms`.

    Args:
        rooms: folders of the project, such as "tracks" or "suite/train".
    """
    sums = hashlib.sha256()
    for room in rooms:
        for path in sorted((ROOT / room).rglob("*.py")):
            name = path.relative_to(ROOT)
            if not set(name.parts) & set(NO_RESULT):
                sums.update(f"{name.as_posix()}\0".encode() + path.read_bytes())
    return sums.hexdigest()[:16]


@functools.cache
def engines() -> dict[str, str | None]:
    """Return what else can change a number: processor, and versions of what computes."""
    versions = package_versions()
    names = ("numpy", "jax", "jaxlib", "mujoco", "mujoco-mjx", "torch", "onnxruntime", "rotorpy")
    return {"processor": machine()["processor"], **{name: versions[name] for name in names}}

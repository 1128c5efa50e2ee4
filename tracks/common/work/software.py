"""What must be the same on two machines for the same work to come to the same bits."""

from __future__ import annotations

import functools
import hashlib
import platform
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path

from tracks.common.version import VERSION

ROOT = Path(__file__).resolve().parents[3]
ROOMS = ("tracks", "policies", "eval", "suite")
PACKAGES = ("numpy", "scipy", "jax", "jaxlib", "mujoco", "mujoco-mjx", "onnxruntime")


@functools.cache
def software() -> dict[str, str]:
    """Return versions of what computes by name, and 16 hex digits that stand for our own code."""
    sums = hashlib.sha256()
    for path in sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py")):
        sums.update(f"{path.relative_to(ROOT).as_posix()}\0".encode() + path.read_bytes())
    return {
        "Python": ".".join(platform.python_version_tuple()[:2]),
        "diffracing-suite": VERSION,
        **{name: _version(name) for name in PACKAGES},
        "the suite's code": sums.hexdigest()[:16],
    }


def differences(theirs: Mapping[str, str], ours: Mapping[str, str]) -> str:
    """Return what differs, in words; "" where nothing does."""
    names = [name for name in ours if theirs.get(name) != ours[name]]
    return ", ".join(f"{name} {theirs.get(name)} there, {ours[name]} here" for name in names)


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "none"

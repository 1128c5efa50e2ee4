"""Work, pieces and results as bytes: what goes to another process or machine and comes back.

`software` says what must be the same on two machines for the same work to come to the same bits.
"""

from __future__ import annotations

import copyreg
import functools
import hashlib
import pickle
import platform
import traceback
from collections.abc import Callable, Mapping
from importlib import metadata
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from tracks.common.provenance import VERSION

ROOT = Path(__file__).resolve().parents[3]
"""Of the code; another machine may have it elsewhere."""


class WorkerDied(RuntimeError):
    """A process that worked for this one was killed, or ended where it should not."""


class Failure(NamedTuple):
    """An error that work elsewhere ended with."""

    error: Exception
    """Itself."""
    lines: str
    """Its traceback."""
    root: str
    """Of the code there."""


class _RemoteTraceback(Exception):
    """Where an error came up, in the words of the process in which it did."""

    def __init__(self, lines: str) -> None:
        super().__init__(lines)
        self.lines = lines

    def __str__(self) -> str:
        return f'\n"""\n{self.lines}"""'


def pack(value: Any) -> bytes:
    """Return `value` as bytes.

    Raises:
        ValueError: where it cannot travel.
    """
    let_views_travel()
    try:
        return pickle.dumps(value, protocol=5)
    except Exception as error:
        raise ValueError(
            f"cannot be sent to other processes ({error}); give functions at the top of a module "
            "and plain values (for a policy: functools.partial(load_policy, name)), or work in "
            "one process"
        ) from error


def let_views_travel() -> None:
    """Let read-only views of dicts be pickled; a vehicle's effects are one."""
    copyreg.pickle(MappingProxyType, _reduce_view)


unpack: Callable[[bytes], Any] = pickle.loads
"""Of bytes that `pack` made. Who sends them can run code here: processes of ours, and whoever runs
a cluster that `--workers` names."""


def failure(error: Exception) -> Failure:
    """Return an error as it travels, one that cannot as its words."""
    lines = "".join(traceback.format_exception(error))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        kind = ValueError if isinstance(error, ValueError) else RuntimeError
        error = kind(f"{type(error).__name__}: {error}")
    error.__traceback__ = None
    return Failure(error, lines, str(ROOT))


def raised(there: Failure) -> Exception:
    """Return the error to raise here, with where it came up as its cause."""
    there.error.__cause__ = _RemoteTraceback(there.lines.replace(there.root, str(ROOT)))
    return there.error


def _view(entries: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(entries)


def _reduce_view(view: MappingProxyType[Any, Any]) -> tuple[Any, ...]:
    return _view, (dict(view),)


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

"""Pickle work, its pieces, results and errors, to send them to other processes and machines.

`software` lists the versions that must be equal on two machines for results equal to the bit.
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
"""Folder of the suite's code; another machine may have another folder."""


class WorkerDied(RuntimeError):
    """A worker process was killed or ended unexpectedly."""


class Failure(NamedTuple):
    """An error in another process."""

    error: Exception
    """The exception."""
    traceback: str
    """Its traceback as text."""
    root: str
    """Folder of the code in the other process."""


class _RemoteTraceback(Exception):
    """The traceback of an error in another process."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.text = text

    def __str__(self) -> str:
        return f'\n"""\n{self.text}"""'


def pack(value: Any) -> bytes:
    """Return `value` as bytes.

    Raises:
        ValueError: where it cannot be pickled.
    """
    register_dict_views()
    try:
        return pickle.dumps(value, protocol=5)
    except Exception as error:
        raise ValueError(
            f"cannot be sent to other processes ({error}); give functions at the top of a module "
            "and plain values (for a policy: functools.partial(load_policy, name)), or work in "
            "one process"
        ) from error


def register_dict_views() -> None:
    """Make read-only views of dicts picklable, such as the effects of a vehicle."""
    copyreg.pickle(MappingProxyType, _reduce_view)


unpack: Callable[[bytes], Any] = pickle.loads
"""Return the value of bytes from `pack`. The sender of the bytes can run any code here; senders are
the suite's own processes, and the machines of a cluster given by `--workers`."""


def failure(error: Exception) -> Failure:
    """Return an error for sending; an error that cannot be pickled is replaced by its text."""
    text = "".join(traceback.format_exception(error))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        kind = ValueError if isinstance(error, ValueError) else RuntimeError
        error = kind(f"{type(error).__name__}: {error}")
    error.__traceback__ = None
    return Failure(error, text, str(ROOT))


def remote_error(failed: Failure) -> Exception:
    """Return the error to raise here, with the remote traceback as its cause."""
    failed.error.__cause__ = _RemoteTraceback(failed.traceback.replace(failed.root, str(ROOT)))
    return failed.error


def _view(entries: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(entries)


def _reduce_view(view: MappingProxyType[Any, Any]) -> tuple[Any, ...]:
    return _view, (dict(view),)


OWN_PACKAGES = ("tracks", "policies", "eval", "suite")
"""The suite's packages."""
PACKAGES = ("numpy", "scipy", "jax", "jaxlib", "mujoco", "mujoco-mjx", "onnxruntime")
"""Other packages whose version influences the computed numbers."""


@functools.cache
def software() -> dict[str, str]:
    """Return the version of each relevant package, and a digest of the suite's own code.

    The digest is the first 16 hex digits of the SHA-256 of all Python files and their paths.
    """
    digest = hashlib.sha256()
    for path in sorted(path for name in OWN_PACKAGES for path in (ROOT / name).rglob("*.py")):
        digest.update(f"{path.relative_to(ROOT).as_posix()}\0".encode() + path.read_bytes())
    return {
        "Python": ".".join(platform.python_version_tuple()[:2]),
        "diffracing-suite": VERSION,
        **{name: _version(name) for name in PACKAGES},
        "the suite's code": digest.hexdigest()[:16],
    }


def differences(theirs: Mapping[str, str], ours: Mapping[str, str]) -> str:
    """Return the differences of two results of `software` as text; "" for none."""
    names = [name for name in ours if theirs.get(name) != ours[name]]
    return ", ".join(f"{name} {theirs.get(name)} there, {ours[name]} here" for name in names)


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "none"

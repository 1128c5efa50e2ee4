"""Work, pieces and results as bytes: what goes to another process or machine and comes back."""

from __future__ import annotations

import copyreg
import pickle
import traceback
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

ROOT = str(Path(__file__).resolve().parents[3])
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
"""Of bytes that `pack` made; only what our own processes send is unpacked."""


def failure(error: Exception) -> Failure:
    """Return an error as it travels, one that cannot as its words."""
    lines = "".join(traceback.format_exception(error))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        kind = ValueError if isinstance(error, ValueError) else RuntimeError
        error = kind(f"{type(error).__name__}: {error}")
    error.__traceback__ = None
    return Failure(error, lines, ROOT)


def raised(there: Failure) -> Exception:
    """Return the error to raise here, with where it came up as its cause."""
    there.error.__cause__ = _RemoteTraceback(there.lines.replace(there.root, ROOT))
    return there.error


def _view(entries: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(entries)


def _reduce_view(view: MappingProxyType[Any, Any]) -> tuple[Any, ...]:
    return _view, (dict(view),)

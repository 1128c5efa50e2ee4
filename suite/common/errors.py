"""Exit codes, and what is printed when a command does not end well.

A mistake of the user gets one message and no traceback. What nobody foresaw keeps its traceback,
for it is a bug and we want to see it.
"""

from __future__ import annotations

import dis
import errno
import os
from pathlib import Path
from types import TracebackType

SHOWN = 300
"""Characters of a name in a message."""
DONE = 0
"""The work is done."""
FAILED = 1
"""The work failed: the disk is full, training diverged, or a bug of ours."""
UNUSABLE = 2
"""The input cannot be used: a wrong name, value or file."""
INTERRUPTED = 130
"""Ctrl-C, or asked to end."""

_ROOT = Path(__file__).resolve().parents[2]
_ROOMS = tuple(str(_ROOT / room) for room in ("tracks", "policies", "eval", "suite"))
_FULL = (errno.ENOSPC, errno.EDQUOT)
_UNUSABLE = (errno.EROFS, errno.ENAMETOOLONG, errno.ELOOP, errno.ENXIO, errno.EINVAL)
_OURS = (errno.EBADF, errno.EFAULT, errno.EDOM, errno.ERANGE, errno.ENOTSOCK, errno.ECHILD)
"""What the system says of a mistake in the program, not of the machine that it runs on."""
_NO_SUCH_INPUT = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError)
_NUL = "embedded null"
"""In what Python says of such a name."""
_NO_BACKEND = ("Unable to initialize backend", "Unknown backend")
"""At the start of what JAX says where JAX_PLATFORMS names what is not there."""


_NO_SETTING = "invalid value for environment variable"
"""At the start of what MuJoCo says of MUJOCO_GL."""


class WorkFailed(RuntimeError):
    """The input was fine and the work could not be done; the message says what to do next."""


def explain(error: BaseException) -> tuple[int, str] | None:
    """Return (exit code, message) for an error that needs no traceback, None for a bug.

    A `ValueError` counts as a message to the user only where our own code raised it on purpose
    (or its class is ours): one that numpy or a cast threw is a bug.
    """
    from tracks.common.work import WorkerDied

    if isinstance(error, (WorkFailed, WorkerDied)):
        return FAILED, str(error)
    if isinstance(error, OSError):
        return _explain_os(error)
    if isinstance(error, ValueError) and _NUL in str(error):
        return UNUSABLE, "the name of a file or folder holds a NUL character; give another name"
    if isinstance(error, ValueError) and _raised_on_purpose(error):
        return UNUSABLE, str(error)
    if isinstance(error, ModuleNotFoundError) and not _is_ours(error.name):
        hint = "install the suite with its requirements (make env, or pip install -e .)"
        return FAILED, f"the package {error.name!r} is missing: {hint}"
    if isinstance(error, RuntimeError) and str(error).startswith(_NO_BACKEND):
        asked = os.environ.get("JAX_PLATFORMS", "")
        first = str(error).splitlines()[0][:SHOWN]
        return UNUSABLE, f"JAX_PLATFORMS is {asked!r} in the environment: {first}; unset it"
    if isinstance(error, RuntimeError) and str(error).startswith(_NO_SETTING):
        return UNUSABLE, f"{error}; unset it"
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return FAILED, "out of memory: use fewer trials, a smaller batch, or a larger machine"
    return None


def _explain_os(error: OSError) -> tuple[int, str] | None:
    where = f": {str(error.filename)[:SHOWN]}" if error.filename else ""
    if error.errno in _FULL:
        hint = "free some space or give another --out; what was finished before is kept"
        return FAILED, f"the disk is full{where}; {hint}"
    if isinstance(error, (*_NO_SUCH_INPUT, PermissionError)) or error.errno in _UNUSABLE:
        return UNUSABLE, f"{(error.strerror or 'cannot be used').lower()}{where}"
    if error.errno and error.errno not in _OURS:
        return FAILED, f"{(error.strerror or 'the system refuses').lower()}{where}"
    return None


def _is_ours(module: str | None) -> bool:
    return (module or "").split(".")[0] in {Path(room).name for room in _ROOMS}


def _raised_on_purpose(error: ValueError) -> bool:
    if _is_ours(type(error).__module__):
        return True
    remote = error.__cause__
    if type(remote).__name__ == "_RemoteTraceback":
        return _remote_raise(str(remote))
    last: TracebackType | None = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    if last is None or not last.tb_frame.f_code.co_filename.startswith(_ROOMS):
        return False
    # A C function that fails has no frame of its own: only a raise statement is on purpose.
    opcode = last.tb_frame.f_code.co_code[last.tb_lasti]
    return dis.opname[opcode] == "RAISE_VARARGS"


def _remote_raise(text: str) -> bool:
    """Say whether a worker process's traceback (as text) ends at a raise in one of our rooms."""
    lines = text.splitlines()
    frames = [i for i, line in enumerate(lines) if line.startswith('  File "')]
    if not frames:
        return False
    path = lines[frames[-1]].split('"')[1]
    statement = lines[frames[-1] + 1].strip() if frames[-1] + 1 < len(lines) else ""
    return path.startswith(_ROOMS) and statement.startswith("raise ")

"""Exit codes of commands, and the messages of failed ones.

A user's mistake, or a failure of the machine, gives one message and no traceback. Any other error
is a bug of the suite and keeps its traceback.
"""

from __future__ import annotations

import dis
import errno
import os
from pathlib import Path
from traceback import walk_tb
from types import TracebackType

SHOWN = 300
"""Largest number of characters of a name in a message."""
DONE = 0
"""Exit code: the work is done."""
FAILED = 1
"""Exit code: the work failed. The disk is full, a training diverged, or the suite has a bug."""
UNUSABLE = 2
"""Exit code: the input cannot be used. A name, a value or a file is wrong."""
INTERRUPTED = 130
"""Exit code: the command was interrupted by Ctrl-C or by a signal to end."""

_ROOT = Path(__file__).resolve().parents[2]
"""Folder of the four packages."""
_PACKAGES = tuple(str(_ROOT / room) for room in ("tracks", "policies", "eval", "suite"))
"""Folders of the suite's four packages."""
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors of the operating system about a full disk or a used-up quota."""
_BAD_PATH = (errno.EROFS, errno.ENAMETOOLONG, errno.ELOOP, errno.ENXIO, errno.EINVAL)
"""Errors of the operating system about a path that cannot be used."""
_BUGS = (errno.EBADF, errno.EFAULT, errno.EDOM, errno.ERANGE, errno.ENOTSOCK, errno.ECHILD)
"""Errors of the operating system that a mistake in the program causes."""
_NO_SUCH_INPUT = (FileNotFoundError, FileExistsError, NotADirectoryError, IsADirectoryError)
"""Errors about a file or folder that the user named wrongly."""
_NO_BACKEND = ("Unable to initialize backend", "Unknown backend")
"""Beginnings of JAX's message if JAX_PLATFORMS names a missing backend."""


class WorkFailed(RuntimeError):
    """Work on valid input failed; the message has the next step."""


def explain(error: BaseException) -> tuple[int, str] | None:
    """Return (exit code, message) for an error that needs no traceback, None for a bug.

    A `ValueError` counts as a message to the user only if the suite raised it on purpose: by a
    `raise` statement in its code, or as an exception class of the suite. A `ValueError` from numpy
    or from a conversion is a bug.
    """
    from tracks.common.work import WorkerDied

    if isinstance(error, (WorkFailed, WorkerDied)):
        return FAILED, str(error)
    if _is_of_cluster(error):
        return FAILED, (
            f"the cluster of --workers does not answer any more ({str(error)[:SHOWN]}); finished "
            "work is kept: start scheduler and workers again, and repeat the command to continue"
        )
    if isinstance(error, OSError):
        return _explain_os(error)
    if isinstance(error, ValueError) and "embedded null" in str(error):
        return UNUSABLE, "the name of a file or folder has a NUL character; give another name"
    if isinstance(error, ValueError) and _is_message(error):
        return UNUSABLE, str(error)
    if isinstance(error, ModuleNotFoundError) and not _is_suite_module(error.name):
        hint = "install the suite with its requirements (make env, or pip install -e .)"
        return FAILED, f"the package {error.name!r} is missing: {hint}"
    if isinstance(error, RuntimeError) and str(error).startswith(_NO_BACKEND):
        platforms = os.environ.get("JAX_PLATFORMS", "")
        reason = str(error).splitlines()[0][:SHOWN]
        return UNUSABLE, f"JAX_PLATFORMS is {platforms!r} in the environment: {reason}; unset it"
    # MuJoCo's message if MUJOCO_GL has a wrong value.
    no_setting = "invalid value for environment variable"
    if isinstance(error, RuntimeError) and str(error).startswith(no_setting):
        return UNUSABLE, f"{error}; unset it"
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return FAILED, "out of memory: use fewer trials, a smaller batch, or a larger machine"
    return None


def _explain_os(error: OSError) -> tuple[int, str] | None:
    """Return (exit code, message) for an error of the operating system, None for a bug."""
    file = f": {str(error.filename)[:SHOWN]}" if error.filename else ""
    if error.errno in _DISK_FULL:
        hint = "free some space or give another --out; finished work is kept"
        return FAILED, f"the disk is full{file}; {hint}"
    if isinstance(error, FileExistsError) and error.filename:
        return UNUSABLE, f"a folder is needed, but a file exists{file}; give another --out"
    if isinstance(error, PermissionError):
        return UNUSABLE, f"permission denied{file}; change its permissions, or give another path"
    if isinstance(error, _NO_SUCH_INPUT) or error.errno in _BAD_PATH:
        return UNUSABLE, f"{(error.strerror or 'cannot be used').lower()}{file}"
    if error.errno and error.errno not in _BUGS:
        return FAILED, f"{(error.strerror or 'the system refuses').lower()}{file}"
    return None


def _is_of_cluster(error: BaseException) -> bool:
    """Return whether the client of the cluster (Dask) raised the error, if the scheduler ended.

    An error of the work passes through the client, too, but another module raised it.
    """
    module = ""
    for frame, _ in walk_tb(error.__traceback__):  # the last one raised it
        module = frame.f_globals.get("__name__", "")
    return module.split(".")[0] == "distributed"


def _is_suite_module(module: str | None) -> bool:
    return (module or "").split(".")[0] in {Path(room).name for room in _PACKAGES}


def _is_message(error: ValueError) -> bool:
    """Return whether the suite raised the error on purpose, by a raise statement or its class."""
    if _is_suite_module(type(error).__module__):
        return True
    # An error of a worker process comes with its traceback as text, as the cause.
    remote = error.__cause__
    if type(remote).__name__ == "_RemoteTraceback":
        return _ends_at_raise(str(remote))
    # The last frame is where the error was raised.
    last: TracebackType | None = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    if last is None or not last.tb_frame.f_code.co_filename.startswith(_PACKAGES):
        return False
    # A failing C function has no frame of its own: only a raise statement is on purpose.
    opcode = last.tb_frame.f_code.co_code[last.tb_lasti]
    return dis.opname[opcode] == "RAISE_VARARGS"


def _ends_at_raise(text: str) -> bool:
    """Return whether a traceback as text ends at a raise statement in the code of the suite."""
    lines = text.splitlines()
    frames = [i for i, line in enumerate(lines) if line.startswith('  File "')]
    if not frames:
        return False
    path = lines[frames[-1]].split('"')[1]
    statement = lines[frames[-1] + 1].strip() if frames[-1] + 1 < len(lines) else ""
    return path.startswith(_PACKAGES) and statement.startswith("raise ")

"""One writer a folder: a lock that is the system's, with a word about who holds it.

The lock is `flock` on the file .lock in the folder, so it ends with the process that holds it,
however that ends, and the file that a killed process leaves says nothing any more.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from tracks.common.files import folder_while_used, sweep_parts, to_json
from tracks.input.reading import InputError, read_json

LOCK = ".lock"
"""Name of the file in the folder; gone when the command ends."""
_BUSY = (errno.EAGAIN, errno.EACCES)
_UNKNOWN = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)


@contextmanager
def one_writer(folder: Path) -> Iterator[None]:
    """Be the only command that writes into `folder`; what killed ones left half-written is swept.

    The folder is made, and taken away again where nothing came into it. Where the file system knows
    no locks nothing is held.

    Raises:
        ValueError: where another command writes there: which, since when, and what to do.
        OSError: where the folder cannot be made or written.
    """
    with folder_while_used(folder):
        handle = _take(folder)
        try:
            sweep_parts(folder)
            yield
        finally:
            # Gone before it is free: whoever opened it meanwhile finds that it is not there.
            (folder / LOCK).unlink(missing_ok=True)
            os.close(handle)


@contextmanager
def one_writer_each(folders: list[Path]) -> Iterator[None]:
    """Be the only command that writes into any of `folders`; see `one_writer`."""
    with contextlib.ExitStack() as stack:
        # Path.resolve raises what is no error of the system where a link leads to itself.
        for folder in dict.fromkeys(Path(os.path.realpath(path)) for path in folders):
            stack.enter_context(one_writer(folder))
        yield


def _take(folder: Path) -> int:
    path = folder / LOCK
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(handle, path):
                os.truncate(handle, 0)
                os.pwrite(handle, (to_json(_about()) + "\n").encode(), 0)
                return handle
        except OSError as error:
            if error.errno in _BUSY:
                os.close(handle)
                raise ValueError(
                    f"{folder} is being written by {_holder(path)}; wait until it is through, end "
                    "it, or give another --out"
                ) from None
            if error.errno in _UNKNOWN:
                return handle
            os.close(handle)
            raise
        # Its holder ended between our opening and our locking, and took the file along.
        os.close(handle)


def _is_at(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except FileNotFoundError:
        return False


def _about() -> dict[str, object]:
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    since = datetime.now(UTC).isoformat(timespec="seconds")
    return {"command": command[:500], "pid": os.getpid(), "host": os.uname().nodename,
            "since": since}  # fmt: skip


def _holder(path: Path) -> str:
    try:
        about = read_json(path)
        return (
            f"`{about['command']}` (pid {about['pid']} on {about['host']}, since {about['since']})"
        )
    except (OSError, InputError, KeyError, TypeError):
        return "another command"

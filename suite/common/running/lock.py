"""Lock an output folder, so that only one command writes into it at a time.

The lock is the system call `flock` on an empty file in the folder, so it ends with the process that
holds it. A second file describes the command of that process (the holder), for the message to
others. Both files have no meaning after the process has ended.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shlex
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from tracks.common.files import folder_while_used, sweep_parts, write_json
from tracks.input.reading import InputError, read_json

LOCK, HOLDER = ".suite-lock", ".suite-lock.json"
"""Names of the lock file and of the file that describes its holder; both are removed at the end."""
_NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)
"""Errors of the operating system on a file system without locks."""


@contextmanager
def one_writer(folder: Path) -> Iterator[None]:
    """Lock `folder`, and remove partial files of killed commands from it.

    A missing folder is made, and removed again if it stays empty. On a file system without locks
    nothing is locked.

    Raises:
        ValueError: if another command writes there. The message has its command line, its start
            and what to do.
        OSError: if the folder cannot be made or written.
    """
    from filelock import FileLock, Timeout

    with folder_while_used(folder):
        path = folder / LOCK
        lock = FileLock(path, timeout=0, mode=0o644, fallback_to_soft=False)
        if _is_foreign(path):
            raise ValueError(
                f"{path} is not a lock of the suite, which is an empty file; move it away, or give "
                "another --out"
            )
        try:
            lock.acquire()
        except Timeout:
            raise ValueError(
                f"{folder} is being written by {_holder(folder)}; wait until it ends, stop it, or "
                "give another --out"
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                raise
        try:
            sweep_parts(folder)
            command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
            since = datetime.now(UTC).isoformat(timespec="seconds")
            holder = {"command": command[:500], "pid": os.getpid(), "host": os.uname().nodename}
            write_json(folder / HOLDER, {**holder, "since": since})
            yield
        finally:
            # Removed before the release: a waiting command then makes a new file. In the other
            # order this would remove the next command's lock.
            for name in (HOLDER, LOCK):
                (folder / name).unlink(missing_ok=True)
            lock.release()


def _is_foreign(path: Path) -> bool:
    """Return whether the file at `path` is no lock of the suite, which is an empty file.

    Another command may remove the file at any moment.
    """
    try:
        status = path.stat()
    except FileNotFoundError:
        return False
    return not stat.S_ISREG(status.st_mode) or status.st_size > 0


@contextmanager
def one_writer_each(folders: list[Path]) -> Iterator[None]:
    """Lock all of `folders`; see `one_writer`."""
    with contextlib.ExitStack() as stack:
        # Path.resolve raises no OSError for a link to itself.
        for folder in dict.fromkeys(Path(os.path.realpath(path)) for path in folders):
            stack.enter_context(one_writer(folder))
        yield


def _holder(folder: Path) -> str:
    """Return a description of the command that holds the lock of `folder`."""
    try:
        holder = read_json(folder / HOLDER)
        process = f"pid {holder['pid']} on {holder['host']}, since {holder['since']}"
        return f"`{holder['command']}` ({process})"
    except (OSError, InputError, KeyError, TypeError):
        return "another command"

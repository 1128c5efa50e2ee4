"""One writer per folder: a lock of the operating system, with a description of its holder.

The lock is `flock` on an empty file in the folder, so it ends with the process that holds it. The
holder is described in a second file, which is written under another name and renamed. Both files
have no meaning after the process has ended.
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
"""Names of the two files in the folder; removed when the command ends."""
_UNKNOWN = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)


@contextmanager
def one_writer(folder: Path) -> Iterator[None]:
    """Be the only command that writes into `folder`; partial files of killed commands are removed.

    The folder is made, and removed again if it stays empty. On a file system without locks nothing
    is locked.

    Raises:
        ValueError: if another command writes there: which one, since when, and what to do.
        OSError: if the folder cannot be made or written.
    """
    from filelock import FileLock, Timeout

    with folder_while_used(folder):
        path = folder / LOCK
        lock = FileLock(path, timeout=0, mode=0o644, fallback_to_soft=False)
        if _is_foreign(path):
            raise ValueError(
                f"{path} is not the suite's, whose own is an empty file; move it away, or give "
                "another --out"
            )
        try:
            lock.acquire()
        except Timeout:
            raise ValueError(
                f"{folder} is being written by {_holder(folder)}; wait until it is through, end "
                "it, or give another --out"
            ) from None
        except OSError as error:
            if error.errno not in _UNKNOWN:
                raise
        try:
            sweep_parts(folder)
            write_json(folder / HOLDER, _about())
            yield
        finally:
            # Removed before the release: a waiting command then makes a new file. In the other
            # order this would remove the next command's lock.
            for name in (HOLDER, LOCK):
                (folder / name).unlink(missing_ok=True)
            lock.release()


def _is_foreign(path: Path) -> bool:
    """Return whether the file at `path` is no lock of the suite; it may vanish at any moment."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return False
    return not stat.S_ISREG(found.st_mode) or found.st_size > 0


@contextmanager
def one_writer_each(folders: list[Path]) -> Iterator[None]:
    """Be the only command that writes into any of `folders`; see `one_writer`."""
    with contextlib.ExitStack() as stack:
        # Path.resolve raises no OSError for a link to itself.
        for folder in dict.fromkeys(Path(os.path.realpath(path)) for path in folders):
            stack.enter_context(one_writer(folder))
        yield


def _about() -> dict[str, object]:
    command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
    since = datetime.now(UTC).isoformat(timespec="seconds")
    return {"command": command[:500], "pid": os.getpid(), "host": os.uname().nodename,
            "since": since}  # fmt: skip


def _holder(folder: Path) -> str:
    try:
        about = read_json(folder / HOLDER)
        return (
            f"`{about['command']}` (pid {about['pid']} on {about['host']}, since {about['since']})"
        )
    except (OSError, InputError, KeyError, TypeError):
        return "another command"

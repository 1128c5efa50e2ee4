"""One writer a folder: a lock that is the system's, with a word about who holds it.

The lock is `flock` on a file in the folder, so it ends with the process that holds it, however that
ends. Nothing is written into that file, which may be another program's by its name; who holds it
stands in a second one, which is written under another name and renamed. What a killed process
leaves of both says nothing any more.
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
"""Names of the two files in the folder; gone when the command ends."""
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
            # Gone before it is free: whoever waits for it finds that it is not there and begins
            # anew. The other way round, it would take away the lock of who came next.
            for name in (HOLDER, LOCK):
                (folder / name).unlink(missing_ok=True)
            lock.release()


def _is_foreign(path: Path) -> bool:
    """Say whether what stands at `path` is no lock of ours; another command may just remove its."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return False
    return not stat.S_ISREG(found.st_mode) or found.st_size > 0


@contextmanager
def one_writer_each(folders: list[Path]) -> Iterator[None]:
    """Be the only command that writes into any of `folders`; see `one_writer`."""
    with contextlib.ExitStack() as stack:
        # Path.resolve raises what is no error of the system where a link leads to itself.
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

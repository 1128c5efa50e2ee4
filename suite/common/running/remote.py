"""Do a job on another machine of a cluster, which shares no files with this one.

The other machine gets and returns the content of folders. It works in a folder of the user's cache
that is named by the SHA-256 of the job. So a second worker continues from the files of one that was
killed.
"""

from __future__ import annotations

import hashlib
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from suite.common.running.lock import one_writer
from suite.common.startup import keep_compiled
from tracks.common.files import replacing_folder, user_cache
from tracks.common.work.pickling import pack

Result = TypeVar("Result")
"""Type of the result of a job."""
Content = dict[str, bytes]
"""Path of each file relative to its folder -> content of the file."""


class Job(NamedTuple):
    """Work whose product is a folder."""

    task: Any
    """Data that describe the work."""
    folder: Path
    """Folder of the product; the work continues from files of an earlier call in it."""
    reads: Path | None = None
    """Another folder that the work reads, if there is one."""


class Parcel(NamedTuple):
    """A job that can be sent to another machine: it has the content of its folders."""

    task: Any
    name: str
    """Name of the folder of the product."""
    folder: Content
    """Content of the folder of the product."""
    reads: Content | None
    """Content of the folder that the work reads, if there is one."""


def parcels(jobs: Iterable[Job]) -> Iterator[Parcel]:
    """Yield the jobs as parcels; the folders of a job are read when its parcel is needed."""
    for job in jobs:
        reads = None if job.reads is None else content(job.reads)
        yield Parcel(job.task, job.folder.name, content(job.folder), reads)


def do_remotely(do: Callable[[Job], Result], parcel: Parcel) -> Iterator[tuple[Result, Content]]:
    """Do a received job on this machine; yield its result and the content of its folder."""
    keep_compiled()
    with _work_folder(hashlib.sha256(pack((do, parcel))).hexdigest()[:16]) as parent:
        folder, reads = parent / parcel.name, None
        if not folder.exists():
            replace_content(folder, parcel.folder)
        if parcel.reads is not None:
            reads = parent / "reads"
            replace_content(reads, parcel.reads)
        result = do(Job(parcel.task, folder, reads))
        product = content(folder)
        for path in filter(None, (folder, reads)):
            shutil.rmtree(path)
    yield result, product


def content(folder: Path) -> Content:
    """Return the content of a folder without hidden files; empty if it does not exist."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in files
        if not any(part.startswith(".") for part in path.relative_to(folder).parts)
    }


def replace_content(folder: Path, files: Mapping[str, bytes]) -> None:
    """Replace `folder` by one with these files, completely or not at all."""
    with replacing_folder(folder) as new:
        for name, data in files.items():
            (new / name).parent.mkdir(parents=True, exist_ok=True)
            (new / name).write_bytes(data)


@contextmanager
def _work_folder(name: str) -> Iterator[Path]:
    """Lock the folder `name` in the user's cache, and yield it.

    If it is locked already or cannot be made, yield a temporary folder instead.
    """
    folder = user_cache() / "pieces" / name
    with ExitStack() as stack:
        try:
            stack.enter_context(one_writer(folder))
        except (OSError, ValueError):
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="suite-piece-")))
        yield folder

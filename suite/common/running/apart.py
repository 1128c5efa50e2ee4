"""Work whose product is a folder, on a machine that has none of our folders: they go as content.

There it is done in the user's cache, in a folder named by what is to be done, so that what a killed
worker had saved is continued by the next worker that finds it.
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
from tracks.common.work.travel import pack

Result = TypeVar("Result")
Content = dict[str, bytes]
"""Of a folder's files, by their path within."""


class Job(NamedTuple):
    """Work whose product is a folder."""

    task: Any
    """What is to be done there."""
    folder: Path
    """Its own, with what an earlier call left in it, which it goes on with."""
    reads: Path | None = None
    """Another folder that it reads."""


class Parcel(NamedTuple):
    """A job as it travels."""

    task: Any
    name: str
    """Of its folder."""
    folder: Content
    reads: Content | None


def parcels(jobs: Iterable[Job]) -> Iterator[Parcel]:
    """Yield jobs with the content of their folders, read as they are asked for."""
    for job in jobs:
        reads = None if job.reads is None else content(job.reads)
        yield Parcel(job.task, job.folder.name, content(job.folder), reads)


def do_apart(do: Callable[[Job], Result], parcel: Parcel) -> Iterator[tuple[Result, Content]]:
    """Do a job on this machine and yield its result and the content of its folder."""
    keep_compiled()
    with _place(hashlib.sha256(pack((do, parcel))).hexdigest()[:16]) as place:
        folder, reads = place / parcel.name, None
        if not folder.exists():
            fill(folder, parcel.folder)
        if parcel.reads is not None:
            reads = place / "reads"
            fill(reads, parcel.reads)
        result = do(Job(parcel.task, folder, reads))
        found = content(folder)
        for path in filter(None, (folder, reads)):
            shutil.rmtree(path)
    yield result, found


def content(folder: Path) -> Content:
    """Return the content of a folder, nothing where there is none."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in files
        if not any(part.startswith(".") for part in path.relative_to(folder).parts)
    }


def fill(folder: Path, files: Mapping[str, bytes]) -> None:
    """Make `folder` one of these files, whole or not at all."""
    with replacing_folder(folder) as new:
        for name, data in files.items():
            (new / name).parent.mkdir(parents=True, exist_ok=True)
            (new / name).write_bytes(data)


@contextmanager
def _place(name: str) -> Iterator[Path]:
    """Be alone in a folder of that name in the user's cache, or else in one for this once."""
    place = user_cache() / "pieces" / name
    with ExitStack() as stack:
        try:
            stack.enter_context(one_writer(place))
        except (OSError, ValueError):
            place = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="suite-piece-")))
        yield place

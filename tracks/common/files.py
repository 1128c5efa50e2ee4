"""Files and folders written whole or not at all: beside their final name, then renamed.

A reader, a kill or a full disk never leaves half a file under its final name. What a killed
process leaves beside it starts with a dot and ends in ``.part``.
"""

from __future__ import annotations

import contextlib
import dataclasses
import errno
import glob
import hashlib
import json
import math
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

PART = ".part"
"""Ending of what is being written, or what a killed process left of it."""
PART_NAME = re.compile(r"\.(.+?)-(?:(\d+)-)?[a-z0-9_]{8}\.part")
"""Of it: what it becomes, and the process that makes it."""
LONGEST_STEM = 200
"""Bytes of a file's name in that of what is written beside it: systems allow 255."""
SWEPT_DEPTH = 4
"""Folders within each other that are looked through for it."""


def user_cache(environment: Mapping[str, str] | None = None) -> Path:
    """Return the suite's own folder in the user's cache, made if missing.

    Where there is no home (a container's user may have none), or it cannot be written, it is a
    folder for temporary files that is the user's alone.

    Args:
        environment: variables; those of this process if not given.
    """
    values = os.environ if environment is None else environment
    try:
        place = values.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
        folder = Path(place) / "diffracing-suite"
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if os.access(folder, os.W_OK):
            return folder
    except (OSError, RuntimeError):  # RuntimeError: nobody knows where home is
        pass
    folder = Path(tempfile.gettempdir()) / f"diffracing-suite-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    # What lies there is loaded as code: it must be nobody else's.
    if found.st_uid != os.getuid() or found.st_mode & 0o022 or not folder.is_dir():
        folder = Path(tempfile.mkdtemp(prefix="diffracing-suite-"))
    return folder


@contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Let errors of the system that name no file, as those of a full disk, name `path`."""
    try:
        yield
    except OSError as error:
        if error.errno and error.filename is None:
            error.filename = os.fspath(path)
        raise


@contextmanager
def replacing_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a path to write to; on a clean exit it becomes `path`, on an error it is removed.

    The yielded path keeps the suffix of `path`, so that writers that go by it still do. Missing
    parent folders are made.

    Raises:
        OSError: where the disk is full or `path` cannot be written; `path` is then untouched.
    """
    final = Path(path)
    final.parent.mkdir(parents=True, exist_ok=True)
    folder = Path(tempfile.mkdtemp(prefix=_prefix(final), suffix=PART, dir=final.parent))
    temporary = folder / final.name
    try:
        with naming(final):
            yield temporary
            _sync(temporary)
        os.replace(temporary, final)
        _sync(final.parent)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def replacing_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield an empty folder to fill; on a clean exit it becomes `path`, else it is removed.

    A folder that already stands at `path` is replaced by two renames; after a kill exactly
    between them `recover_folder` brings the new one in.

    Raises:
        OSError: where the disk is full or `path` cannot be written.
    """
    final = Path(path)
    final.parent.mkdir(parents=True, exist_ok=True)
    parent = Path(tempfile.mkdtemp(prefix=_prefix(final), suffix=PART, dir=final.parent))
    temporary = parent / final.name
    temporary.mkdir()
    retired = parent / "replaced"
    try:
        with naming(final):
            yield temporary
            for written in sorted(temporary.rglob("*")):
                _sync(written)
        if final.exists():
            os.replace(final, retired)
        os.replace(temporary, final)
        _sync(final.parent)
    finally:
        # Also for an interrupt that comes between the two renames.
        if retired.exists() and not final.exists():
            os.replace(retired, final)
        shutil.rmtree(parent, ignore_errors=True)


def recover_folder(path: str | os.PathLike[str]) -> None:
    """Put `path` in place where a kill between the two renames of `replacing_folder` left it out.

    The new folder was complete and on the disk by then, so it is the one taken. Readers of
    folders that are replaced call this first.
    """
    final = Path(path)
    if final.exists():
        return
    for part in final.parent.glob(f".{glob.escape(_stem(final))}-*.part"):
        if _is_being_written(part.name):
            continue
        if (part / "replaced").is_dir() and (part / final.name).is_dir():
            os.replace(part / final.name, final)
            shutil.rmtree(part, ignore_errors=True)
            return


@contextmanager
def folder_while_used(path: str | os.PathLike[str]) -> Iterator[None]:
    """Make a folder and what it lies in; what nothing came into is taken away again at the end.

    Raises:
        OSError: where it cannot be made.
    """
    folder = Path(path)
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for each in made:
            with contextlib.suppress(OSError):
                each.rmdir()


def check_place(path: str | os.PathLike[str]) -> None:
    """Find out whether a file can be written at `path` before the work that makes it; writes none.

    Raises:
        OSError: where it cannot.
    """
    final = Path(path)
    with folder_while_used(final.parent):
        if final.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(final))
        os.rmdir(tempfile.mkdtemp(prefix=_prefix(final), suffix=PART, dir=final.parent))


def check_no_input(
    path: str | os.PathLike[str], inputs: Iterable[str | os.PathLike[str] | None], option: str
) -> None:
    """Refuse to write a file that is read as well.

    Args:
        path: what is to be written.
        inputs: what is read; names that are no files are passed over.
        option: what says where `path` is.

    Raises:
        ValueError: naming the file, and the option to change.
    """
    for given in inputs:
        if given and os.path.exists(given) and os.path.exists(path):
            if os.path.samefile(given, path):
                raise ValueError(
                    f"{option}: {os.fspath(path)} is read, too, and would be written over; give "
                    f"another {option}"
                )


def sweep_parts(folder: str | os.PathLike[str]) -> list[Path]:
    """Remove what killed processes left half-written in a folder and below, and return it.

    What a process that lives is writing stays, and a whole folder that a kill between the two
    renames of `replacing_folder` left aside is put in place. Only for who alone writes there.
    """
    swept = []
    start = os.fspath(folder)
    for place, names, _ in os.walk(start):
        depth = os.path.relpath(place, start).count(os.sep)
        for name in [name for name in names if name.startswith(".") and name.endswith(PART)]:
            names.remove(name)
            match = PART_NAME.fullmatch(name)
            if match and not _is_being_written(name):
                for whole in os.listdir(Path(place, name)):  # of a long name the start stands there
                    recover_folder(Path(place, whole))
                shutil.rmtree(Path(place, name), ignore_errors=True)
                swept.append(Path(place, name))
        if depth >= SWEPT_DEPTH:
            names.clear()
    return swept


def _prefix(final: Path) -> str:
    # Who writes it stands in the name, so that another process can tell whether it still does.
    return f".{_stem(final)}-{os.getpid()}-"


def _stem(final: Path) -> str:
    """Return the start of a name that leaves room for what is added to it beside the file."""
    return os.fsencode(final.name)[:LONGEST_STEM].decode(errors="ignore")


def _is_being_written(part: str) -> bool:
    """Return whether the process that made a part, by its name, may still be writing it."""
    match = PART_NAME.fullmatch(part)
    return bool(match and match[2] and _is_alive(int(match[2])))


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True


def _sync(path: Path) -> None:
    """Flush to the disk, so that a rename does not outlive the data after a power cut."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write `text` to `path` as UTF-8, whole or not at all."""
    with replacing_file(path) as temporary:
        # A name that is not UTF-8, as a folder's above may be, is written as an escape.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write `value` to `path` as indented JSON (see `to_json`), whole or not at all."""
    write_text(path, to_json(value, indent=2) + "\n")


def to_json(value: Any, indent: int | None = None) -> str:
    """Return `value` as strict JSON text.

    Dataclasses and named tuples become objects, arrays lists, paths strings; NaN and infinities
    become null, since JSON has neither.
    """
    return json.dumps(plain(value), indent=indent, allow_nan=False)


def digest_of(value: Any) -> str:
    """Return the SHA-256, 64 hex digits, of `value`, which JSON must be able to hold."""
    return hashlib.sha256(to_json(value).encode()).hexdigest()


def plain(value: Any) -> Any:
    """Return `value` made of dicts, lists, strings, finite numbers, booleans and None only."""
    if isinstance(value, type):
        return value.__qualname__
    if dataclasses.is_dataclass(value):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    names = getattr(value, "_fields", None)
    if isinstance(value, tuple) and names:
        return {name: plain(entry) for name, entry in zip(names, value, strict=True)}
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(entry) for entry in value]
    if value is None or isinstance(value, (str, bool, int)):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    tolist = getattr(value, "tolist", None)
    return plain(tolist()) if tolist else str(value)

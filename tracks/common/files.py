"""Write files and folders atomically: under a temporary name first, which is then renamed.

A kill or a full disk never leaves a partial file under its final name. A temporary folder in the
same parent folder holds what is being written. Its name starts with a dot and ends in ``.part``; a
killed process may leave it behind.
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
"""Ending of a temporary folder, in use or left by a killed process."""
PART_NAME = re.compile(r"\.(.+?)-(?:(\d+)-)?[a-z0-9_]{8}\.part")
"""Pattern of a temporary folder's name: the final name, and the number of the writing process."""
LONGEST_STEM = 200
"""Largest number of bytes of the final name in a temporary name; file systems allow 255 in all."""
SWEPT_DEPTH = 4
"""Depth of folders that `sweep_parts` searches."""


def user_cache(environment: Mapping[str, str] | None = None) -> Path:
    """Return the suite's folder in the user's cache directory, and make it if it is missing.

    Without a writable home directory (as in some containers) it is a private temporary folder.
    """
    variables = os.environ if environment is None else environment
    try:
        cache = Path(variables.get("XDG_CACHE_HOME", ""))
        # A relative path must be ignored: https://specifications.freedesktop.org/basedir
        cache = cache if cache.is_absolute() else Path.home() / ".cache"
        folder = cache / "diffracing-suite"
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if os.access(folder, os.W_OK):
            return folder
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        pass
    folder = Path(tempfile.gettempdir()) / f"diffracing-suite-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    status = folder.lstat()
    # Files in it are loaded as code, so no other user may own or write it.
    if status.st_uid != os.getuid() or status.st_mode & 0o022 or not folder.is_dir():
        folder = Path(tempfile.mkdtemp(prefix="diffracing-suite-"))
    return folder


@contextmanager
def naming(path: str | os.PathLike[str]) -> Iterator[None]:
    """Add `path` to operating system errors without a file name, such as for a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno and error.filename is None:
            error.filename = os.fspath(path)
        raise


@contextmanager
def replacing_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary path to write to; it becomes `path` on success, and is removed on an error.

    The temporary path has the suffix of `path`, which some writers depend on. Missing
    parent folders are made.

    Raises:
        OSError: where the disk is full or `path` cannot be written; `path` is then untouched.
    """
    final = Path(path)
    _refuse_folder(final)
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
    """Yield an empty folder to fill; it becomes `path` on success, and is removed on an error.

    An existing folder at `path` is replaced by two renames. After a kill exactly between them
    `recover_folder` completes the replacement.

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
        # Also after an interrupt between the two renames.
        if retired.exists() and not final.exists():
            os.replace(retired, final)
        shutil.rmtree(parent, ignore_errors=True)


def recover_folder(path: str | os.PathLike[str]) -> None:
    """Complete a replacement by `replacing_folder` that was killed between its two renames.

    Between the renames the new folder is complete on the disk, so it is used. Readers of replaced
    folders call this function first.
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
    """Make a folder and its parents; remove the new ones that are still empty at the end.

    Raises:
        OSError: where the folder cannot be made.
    """
    folder = Path(path)
    new_folders = [parent for parent in (folder, *folder.parents) if not parent.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for new_folder in new_folders:
            with contextlib.suppress(OSError):
                new_folder.rmdir()


def check_place(path: str | os.PathLike[str]) -> None:
    """Check that a file can be written at `path`, without writing it.

    Raises:
        OSError: where it cannot be written.
    """
    final = Path(path)
    with folder_while_used(final.parent):
        _refuse_folder(final)
        os.rmdir(tempfile.mkdtemp(prefix=_prefix(final), suffix=PART, dir=final.parent))


def _refuse_folder(final: Path) -> None:
    """Refuse a folder in place of a file; the error of a rename names the temporary path."""
    if final.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(final))


def check_no_input(
    path: str | os.PathLike[str], inputs: Iterable[str | os.PathLike[str] | None]
) -> None:
    """Refuse to overwrite an input file by the output `path`; inputs that are no files are ignored.

    Raises:
        ValueError: naming the file, and the option --out.
    """
    for input_path in inputs:
        if input_path and os.path.exists(path) and os.path.exists(input_path):
            if os.path.samefile(input_path, path):
                raise ValueError(
                    f"--out: {os.fspath(path)} is also an input and would be overwritten; give "
                    "another --out"
                )


def sweep_parts(folder: str | os.PathLike[str]) -> list[Path]:
    """Remove the temporary folders of killed processes in `folder` and below, and return them.

    Temporary folders of running processes are kept. A folder replacement that was killed between
    its two renames is completed first. Call this only where no other process writes.
    """
    removed = []
    start = os.fspath(folder)
    for parent, subfolders, _ in os.walk(start):
        depth = os.path.relpath(parent, start).count(os.sep)
        for name in [name for name in subfolders if name.startswith(".") and name.endswith(PART)]:
            subfolders.remove(name)
            match = PART_NAME.fullmatch(name)
            if match and not _is_being_written(name):
                # The final name is read from inside, since `name` may hold a shortened one.
                for final_name in os.listdir(Path(parent, name)):
                    recover_folder(Path(parent, final_name))
                shutil.rmtree(Path(parent, name), ignore_errors=True)
                removed.append(Path(parent, name))
        if depth >= SWEPT_DEPTH:
            subfolders.clear()
    return removed


def _prefix(final: Path) -> str:
    # The process number lets others check whether the writer is still running.
    return f".{_stem(final)}-{os.getpid()}-"


def _stem(final: Path) -> str:
    """Return the start of a name, short enough for the additions of the temporary name."""
    return os.fsencode(final.name)[:LONGEST_STEM].decode(errors="ignore")


def _is_being_written(part: str) -> bool:
    """Return whether the writer of a temporary folder may still be running, by its name."""
    match = PART_NAME.fullmatch(part)
    return bool(match and match[2] and _is_alive(int(match[2])))


def _is_alive(process: int) -> bool:
    """Return whether a process with this number runs, or may run."""
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
    """Write `text` to `path` as UTF-8, completely or not at all."""
    with replacing_file(path) as temporary:
        # Characters that are not UTF-8, as in some folders' names, are written as escapes.
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")


def write_files(folder: str | os.PathLike[str], files: Mapping[str, bytes]) -> list[Path]:
    """Write `files` (name to content) to `folder`, or none of them, and return their paths."""
    with contextlib.ExitStack() as stack:
        for name, data in files.items():
            temporary = stack.enter_context(replacing_file(Path(folder, name)))
            temporary.write_bytes(data)
            _sync(temporary)  # a full disk is noticed before the first file gets its name
    return [Path(folder, name) for name in files]


def write_json(path: str | os.PathLike[str], value: Any) -> None:
    """Write `value` to `path` as indented JSON (see `to_json`), completely or not at all."""
    write_text(path, to_json(value, indent=2) + "\n")


def to_json(value: Any, indent: int | None = None) -> str:
    """Return `value` as strict JSON text.

    Dataclasses and named tuples become objects, arrays lists, paths strings; NaN and infinities
    become null, since JSON has neither.
    """
    return json.dumps(plain(value), indent=indent, allow_nan=False)


def digest_of(value: Any) -> str:
    """Return the SHA-256 of the JSON text of `value`, 64 hex digits."""
    return hashlib.sha256(to_json(value).encode()).hexdigest()


def plain(value: Any) -> Any:
    """Return `value` converted to dicts, lists, strings, finite numbers, booleans and None."""
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

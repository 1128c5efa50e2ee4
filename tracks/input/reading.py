"""Read untrusted files safely: kind and size are checked before JSON or TOML is parsed.

The readers raise an `InputError` that names the file for: a pipe or device, which may never end; a
file that would fill the memory; a number with thousands of digits; tables nested too deeply.
"""

from __future__ import annotations

import codecs
import json
import os
import stat
import tomllib
from typing import Any

TEXT_BYTES = 64 * 2**20
"""Size of the largest JSON or TOML file [bytes]."""
MODEL_BYTES = 512 * 2**20
"""Size of the largest ONNX, torch or C policy file, with its external data [bytes]."""
WEIGHTS_BYTES = 2 * 2**30
"""Size of the largest arrays of a checkpoint [bytes]; the widest network with its optimiser state
fits."""
LOG_BYTES = 2 * 2**30
"""Size of the largest flight log of any format [bytes]."""
MESH_BYTES = 256 * 2**20
"""Size of the largest mesh file [bytes]."""
DEPTH = 64
"""Deepest allowed nesting of tables and lists in a JSON or TOML file."""

_FILE_TYPES = {
    stat.S_IFIFO: "a named pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a folder",
}
"""Files that are not regular, with their names in messages."""
_WRONG_FORMATS = {
    b"\x1f\x8b": "compressed by gzip; unpack it",
    b"pk\3\4": "a zip archive or an Excel workbook; unpack it, or save it as CSV in UTF-8",
    b"version https://git-lfs": "a pointer of Git LFS, not the file itself; run git lfs pull",
    b"<!doctype html": "a web page; download the file itself",
    b"<html": "a web page; download the file itself",
}
"""First bytes (in small letters) of files that people pass by mistake -> what the file is, and what
to do."""


class InputError(ValueError):
    """A file cannot be used; the message has its name and what is allowed."""


def check_file(path: str | os.PathLike[str], most_bytes: int) -> None:
    """Refuse a path that is not a regular file, or a file that is too large, before it is opened.

    Symbolic links are followed.

    Raises:
        InputError: with the file, its kind or size, and what is allowed.
        OSError: if the file does not exist.
    """
    _check(os.fspath(path), os.stat(path), most_bytes)


def read_bytes(path: str | os.PathLike[str], most_bytes: int = TEXT_BYTES) -> bytes:
    """Return the contents of a regular file.

    Raises:
        InputError: if it is not a regular file or is too large.
        OSError: if it cannot be read.
    """
    # Non-blocking, because opening a pipe without a writer would block.
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    try:
        _check(os.fspath(path), os.fstat(handle), most_bytes)
        with os.fdopen(handle, "rb", closefd=False) as file:
            data = file.read(most_bytes + 1)
    finally:
        os.close(handle)
    if len(data) > most_bytes:  # files of /proc have size 0
        raise _too_large(os.fspath(path), "more", most_bytes)
    return data


def read_json(path: str | os.PathLike[str], **keys: type) -> dict[str, Any]:
    """Return the object of a JSON file.

    `keys` are required, with the types of their values.

    Raises:
        InputError: if it is not a regular file, is too large, is not JSON, or lacks a required key.
        OSError: if it cannot be read.
    """
    value = parse_json(read_bytes(path), os.fspath(path))
    if not isinstance(value, dict):
        raise InputError(f"{os.fspath(path)}: is a {type(value).__name__}, expected an object")
    for key, kind in keys.items():
        if not isinstance(value.get(key), kind):
            raise InputError(
                f"{os.fspath(path)}: {key!r} is missing or not a {kind.__name__}; the file was "
                "edited or is incomplete: create it again"
            )
    return value


def parse_json(text: str | bytes, where: str) -> Any:
    """Return the value of a JSON text; `where` names its source in messages.

    Raises:
        InputError: if it is not JSON or is nested too deeply.
    """
    try:
        value = json.loads(text)
        # An escaped surrogate without its partner is valid JSON, but cannot be encoded.
        if b"\\ud" in (text if isinstance(text, bytes) else text.encode()).lower():
            json.dumps(value, ensure_ascii=False).encode()
    except RecursionError:
        raise _too_deep(where) from None
    except UnicodeEncodeError:
        raise InputError(f"{where}: has half of a surrogate pair, not valid text") from None
    except ValueError as error:
        raise InputError(f"{where}: not JSON ({error})") from None
    _check_depth(value, where)
    return value


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the table of a TOML file.

    Raises:
        InputError: if it is not a regular file, is too large or is not TOML.
        OSError: if it cannot be read.
    """
    where = os.fspath(path)
    try:
        data = read_bytes(path)
        refuse_other_kinds(data, where)
        table = tomllib.loads(data.decode("utf-8-sig"))
    except RecursionError:
        raise _too_deep(where) from None
    except InputError:
        raise
    except ValueError as error:  # also numbers with thousands of digits, or not UTF-8
        raise InputError(f"{where}: is not TOML: {error}") from None
    _check_depth(table, where)
    return table


def refuse_other_kinds(head: bytes, where: str) -> None:
    """Refuse archives, web pages, pointers of Git LFS and text in UTF-16, by their first bytes.

    Raises:
        InputError: with the kind of file, and what to do.
    """
    for start, advice in _WRONG_FORMATS.items():
        if head[: len(start)].lower() == start:
            raise InputError(f"{where}: {advice}")
    has_mark = head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    # Without a byte order mark: in English text, every second byte is zero.
    first_bytes = head[:64]
    zeros = sorted(first_bytes[k::2].count(b"\0") for k in (0, 1))
    if has_mark or (
        len(first_bytes) >= 8 and zeros == [0, len(first_bytes) // 2] and first_bytes.isascii()
    ):
        raise InputError(
            f"{where}: text in UTF-16, as Excel and PowerShell save it; save it as UTF-8 (Excel: "
            "CSV UTF-8; PowerShell: -Encoding utf8)"
        )


def reason(error: OSError) -> str:
    """Return the operating system's reason why a file cannot be read."""
    return error.strerror or str(error)


def _check(path: str, status: os.stat_result, most_bytes: int) -> None:
    """Refuse a file that is not regular or is too large, by its status."""
    if not stat.S_ISREG(status.st_mode):
        kind = _FILE_TYPES.get(stat.S_IFMT(status.st_mode), "of an unknown kind")
        raise InputError(f"{path}: cannot be read: it is {kind}, not a regular file")
    if status.st_size > most_bytes:
        raise _too_large(path, str(status.st_size), most_bytes)


def _too_large(path: str, size: str, most_bytes: int) -> InputError:
    return InputError(f"{path}: has {size} bytes, allowed are up to {most_bytes}")


def _too_deep(where: str) -> InputError:
    return InputError(f"{where}: tables and lists are nested deeper than the {DEPTH} allowed")


def _check_depth(value: Any, where: str) -> None:
    """Refuse tables and lists that are nested too deeply, level by level."""
    level = [value]
    for _ in range(DEPTH):
        containers = [entry for entry in level if isinstance(entry, dict | list)]
        level = [
            entry
            for container in containers
            for entry in (container.values() if isinstance(container, dict) else container)
        ]
        if not level:
            return
    raise _too_deep(where)

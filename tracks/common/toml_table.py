"""Read TOML tables key by key or as a typed dataclass, and write tables as TOML.

An error names the file, the key, its value, what is allowed and the closest name.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Callable, Iterable, Mapping
from numbers import Integral, Real
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from tracks.common.names import closest, printable, unknown_name
from tracks.common.provenance import stamp, stamp_text
from tracks.input import reading
from tracks.input.ranges import as_path, is_number, shown

T = TypeVar("T")

REQUIRED: Any = object()
"""Default of a key that must be present."""


def read_toml(path: Path) -> Table:
    """Return the whole file as a table.

    Raises:
        ValueError: where the file does not exist or is not TOML, naming the file.
    """
    try:
        return Table(str(path), "", reading.read_toml(path))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({reading.reason(error)})") from None


def shipped_names(folder: Path) -> list[str]:
    """Return the names of the shipped TOML files in a folder."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def load_shipped(
    source: str | os.PathLike[str],
    folder: Path,
    kind: str,
    parse: Callable[[dict[str, Any]], T],
    refused: type[ValueError],
) -> T:
    """Return the object that a TOML file describes.

    Args:
        source: path of the file, or name of a file that the suite ships. A text counts as a path if
            it ends in .toml, has a folder or is an existing file.
        folder: folder of the shipped files.
        kind: name of the kind of file, for messages.
        parse: makes the object from the file's table; raises a ValueError for a wrong value.
        refused: class of the error for a file that cannot be used.

    Raises:
        refused: naming the file.
        ValueError: for a source that is neither a path nor a shipped name.
    """
    path = as_path(kind, source, "a name, as a text, or a path")
    if path.suffix != ".toml" and len(path.parts) == 1 and not path.is_file():
        if str(source) not in shipped_names(folder):
            raise unknown_name(f"{kind} (or file)", str(source), shipped_names(folder))
        path = folder / f"{source}.toml"
    try:
        table = reading.read_toml(path)
    except FileNotFoundError as error:
        known = ", ".join(shipped_names(folder))
        raise refused(f"{path}: no such file; shipped by name: {known}") from error
    except OSError as error:
        raise refused(f"{path}: cannot be read: {reading.reason(error)}") from error
    except reading.InputError as error:
        raise refused(str(error)) from error
    try:
        return parse(table)
    except ValueError as error:
        raise refused(f"{path}: {error}") from error


class Table:
    """One table of a TOML file; it records which keys are read, so that it can refuse others."""

    def __init__(self, source: str, place: str, values: Mapping[str, Any]) -> None:
        """Make a reader of the table `values` in the file `source`.

        Messages begin with `source`; "" for none. `place` is the table's dotted name in the file;
        "" for the whole file.
        """
        self._source, self._place, self.values = source, place, values
        self._known: list[str] = []

    @property
    def path(self) -> Path:
        """Path of the file."""
        return Path(self._source)

    def error(self, key: str, value: object, allowed: str) -> ValueError:
        """Return (not raise) the error for a value that is not allowed under `key`."""
        return self._refused(f"{self._at(key)} is {shown(value)}, allowed is {allowed}")

    def read(self, cls: type[T], also: Iterable[str] = (), **fixed: Any) -> T:
        """Return a dataclass from this table's keys; missing fields take their defaults.

        Fields are numbers, texts, truth values, tuples of these, or dataclasses. `also` are further
        allowed keys; `fixed` has the values of fields that are not in the table.
        """
        fields = {field.name: field for field in dataclasses.fields(cls) if field.name not in fixed}  # pyrefly: ignore[bad-argument-type]
        self.expect([*fields, *also])
        hints = get_type_hints(cls)
        for name, field in fields.items():
            required = field.default is field.default_factory is dataclasses.MISSING
            if required or self.has(name):
                fixed[name] = self.value(name, hints[name])
        return cls(**fixed)

    def value(self, key: str, kind: Any, default: Any = REQUIRED) -> Any:
        """Return the value of `key` as `kind`, one of the field types of `read`."""
        value = self._get(key, default, _describe(kind))
        return value if key not in self.values else self._typed(key, value, kind)

    def choice(self, key: str, allowed: Iterable[str]) -> str:
        """Return one of the texts `allowed`; the first where the key is absent."""
        allowed = list(allowed)
        value = self._get(key, allowed[0], "a text")
        if not isinstance(value, str) or value not in allowed:
            raise self.error(key, value, " or ".join(map(repr, allowed)))
        return value

    def _typed(self, key: str, value: Any, kind: Any) -> Any:
        """Return `value` converted to the type `kind`, or refuse it."""
        parts = get_args(kind)
        if get_origin(kind) in (Union, UnionType):  # a type or None
            return None if value is None else self._typed(key, value, parts[0])
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            if not isinstance(value, Mapping):
                raise self.error(key, value, f"a table [{self._at(key)}]")
            return Table(self._source, self._at(key), value).read(kind)
        if parts[1:] == (...,):
            if not isinstance(value, list | tuple):
                raise self.error(key, value, _describe(kind))
            return tuple(self._typed(f"{key}[{i}]", v, parts[0]) for i, v in enumerate(value))
        if get_origin(kind) is tuple:
            if not isinstance(value, list | tuple) or len(value) != len(parts):
                raise self.error(key, value, _describe(kind))
            entries = enumerate(zip(value, parts, strict=True))
            return tuple(self._typed(f"{key}[{i}]", v, part) for i, (v, part) in entries)
        plain: Any = kind
        valid = isinstance(value, plain) if plain in (bool, str) else is_number(value)
        if not valid or value == "" or (plain is int and value != int(value)):
            raise self.error(key, value, _describe(kind))
        return plain(value)

    def has(self, key: str) -> bool:
        """Return whether the key is present; it then counts as known."""
        if key not in self._known:
            self._known.append(key)
        return key in self.values

    def number(
        self,
        key: str,
        default: float = REQUIRED,
        above: float = -math.inf,
        least: float = -math.inf,
        most: float = math.inf,
    ) -> float:
        """Return a finite number greater than `above`, from `least` to `most`."""
        value = self._get(key, default, "a number")
        if not (is_number(value) and above < value and least <= value <= most):
            raise self.error(key, value, "a number" + _limits(above, least, most))
        return float(value)

    def whole(self, key: str, default: int = REQUIRED, least: int = 0, most: int = 2**31) -> int:
        """Return a whole number from `least` to `most`."""
        value = self._get(key, default, "a whole number")
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            raise self.error(key, value, f"a whole number from {least} to {most}")
        return value

    def text(self, key: str, default: str = REQUIRED) -> str:
        """Return a text that is not empty and holds no control characters."""
        value = self._get(key, default, "a text")
        if not isinstance(value, str) or not value or printable(value, keep="") != value:
            raise self.error(key, value, "a printable text that is not empty")
        return value

    def texts(self, key: str) -> list[str]:
        """Return a list of texts, none of them empty."""
        value = self._get(key, REQUIRED, "a list of texts")
        if not isinstance(value, list) or not all(isinstance(v, str) and v for v in value):
            raise self.error(key, value, "a list of texts that are not empty")
        return value

    def vector(
        self,
        key: str,
        size: int,
        default: Iterable[float] = REQUIRED,
        least: float = -math.inf,
        most: float = math.inf,
    ) -> np.ndarray:
        """Return `size` finite numbers, each from `least` to `most`."""
        value = self._get(key, default, f"{size} numbers")
        valid = isinstance(value, list | tuple) and len(value) == size
        if not valid or not all(is_number(entry) and least <= entry <= most for entry in value):
            limits = _limits(-math.inf, least, most)
            raise self.error(key, value, f"a list of {size} numbers{limits and ', each' + limits}")
        return np.array(value, float)

    def points(self, key: str, size: int, least: int, most: float = math.inf) -> np.ndarray:
        """Return at least `least` points of `size` numbers from -`most` to `most`, (N, size)."""
        value = self._get(key, REQUIRED, "a list of points")
        rows = value if isinstance(value, list) else []

        def fits(entry: object) -> bool:
            return is_number(entry) and -most <= entry <= most

        valid = len(rows) >= least and all(
            isinstance(row, list) and len(row) == size and all(map(fits, row)) for row in rows
        )
        if not valid:
            raise self.error(
                key,
                value,
                f"a list of {least} or more [{size} numbers{_limits(-math.inf, -most, most)}]",
            )
        return np.array(value, float)

    def table(self, key: str, default: Mapping[str, Any] = REQUIRED) -> Table:
        """Return a table below this one."""
        value = self._get(key, default, f"a table [{self._at(key)}]")
        if not isinstance(value, Mapping):
            raise self.error(key, value, f"a table [{self._at(key)}]")
        return Table(self._source, self._at(key), value)

    def tables(self, key: str) -> list[Table]:
        """Return the tables of an array [[key]], none where it is absent."""
        value = self._get(key, [], f"tables [[{key}]]")
        if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
            raise self.error(key, value, f"tables [[{key}]]")
        return [Table(self._source, f"{key}[{i}]", entry) for i, entry in enumerate(value)]

    def close(self) -> None:
        """Refuse every key that was not read."""
        self.expect(self._known)

    def expect(self, allowed: Iterable[str]) -> None:
        """Refuse every key outside `allowed`."""
        allowed = list(allowed)
        for key in self.values:
            if key not in allowed:
                similar = closest(key, allowed)
                hint = f" Did you mean {similar!r}?" if similar else ""
                where = f"in [{self._place}]" if self._place else "at the top"
                raise self._refused(
                    f"key {shown(key)} {where} is unknown.{hint} Allowed: {', '.join(allowed)}."
                )

    def _get(self, key: str, default: Any, kind: str) -> Any:
        """Return the value of `key` or `default`; refuse a missing key that is required."""
        if self.has(key):
            return self.values[key]
        if default is REQUIRED:
            where = f"[{self._place}]" if self._place else "the file"
            raise self._refused(f"{where} has no {key!r}; add it ({kind})")
        return default

    def _at(self, key: str) -> str:
        return f"{self._place}.{key}" if self._place else key

    def _refused(self, text: str) -> ValueError:
        return ValueError(f"{self._source}: {text}" if self._source else text)


def _describe(kind: Any) -> str:
    """Return a text that describes the allowed values of the type `kind`."""
    if get_origin(kind) is not tuple:
        names = {bool: "true or false", int: "a whole number", float: "a finite number"}
        return names.get(kind, "a text that is not empty" if kind is str else "a table")
    parts, inner = get_args(kind), get_args(get_args(kind)[0])
    if parts[1:] == (...,):
        return "a list"
    each = f"lists of {len(inner)} numbers" if inner else "numbers"
    return f"a list of {len(parts)} {each}"


def _limits(above: float, least: float, most: float) -> str:
    """Return the limits as a text such as " from 0 to 1"; empty where there are none."""
    low = "" if least == -math.inf else f" from {least:g}"
    low = low if above == -math.inf else f" above {above:g}"
    return low + ("" if most == math.inf else f" {'to' if low else 'up to'} {most:g}")


def toml_head(comment: str, schema: int) -> str:
    """Return TOML comments for the start of a file: the lines of `comment`, and provenance."""
    lines = [*comment.splitlines(), stamp_text(stamp(schema, None))]
    return "".join(f"# {printable(line)}\n" for line in lines)


def to_toml(table: Mapping[str, Any], prefix: str = "") -> str:
    """Return `table` as TOML that reads back equal; plain keys come before subtables."""
    lines = [
        f"{key} = {_value(entry)}\n"
        for key, entry in table.items()
        if not isinstance(entry, Mapping) and not _is_array(entry)
    ]
    for key, entry in table.items():
        for subtable in entry if _is_array(entry) else ():
            lines.append(f"\n[[{prefix}{key}]]\n{to_toml(subtable, f'{prefix}{key}.')}")
        if isinstance(entry, Mapping):
            inside = to_toml(entry, f"{prefix}{key}.")
            only_tables = entry and all(isinstance(value, Mapping) for value in entry.values())
            head = "" if only_tables else f"\n[{prefix}{key}]\n"
            lines.append(head + inside)
    return "".join(lines)


def _is_array(entry: Any) -> bool:
    """Return whether this is an array of tables."""
    return isinstance(entry, list) and bool(entry) and all(isinstance(t, Mapping) for t in entry)


def _value(value: Any) -> str:
    """Return a value that is not a table as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Integral):
        return str(int(value))
    if isinstance(value, Real):
        return repr(float(value))  # the repr of numpy's floats contains their type
    if isinstance(value, str):
        # TOML's basic strings use JSON's escapes, and DEL must be escaped as well.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_value(entry) for entry in value) + "]"
    raise TypeError(f"TOML has no {type(value).__name__}: {value!r}")

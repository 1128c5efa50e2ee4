"""Tables of a person's TOML file, read key by key and refused by file and key; and TOML as text."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tracks.common.names import closest
from tracks.input import reading
from tracks.input.ranges import is_number, shown

REQUIRED: Any = object()
"""In place of a default: the key must be there."""


def read_toml(path: Path) -> Table:
    """Return the whole file as a table.

    Raises:
        ValueError: where there is no such file or it is no TOML, naming the file.
    """
    try:
        return Table(path, "", reading.read_toml(path))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({reading.reason(error)})") from None


class Table:
    """One table of a file; every key that is asked for counts as known."""

    def __init__(self, path: Path, place: str, values: dict[str, Any]) -> None:
        self.path = path
        self._place = place
        self._values = values
        self._known: list[str] = []

    def error(self, key: str, value: object, allowed: str) -> ValueError:
        """Return (not raise) the error for a value that is not allowed under `key`."""
        where = f"{self._place}.{key}" if self._place else key
        return ValueError(f"{self.path}: {where} is {shown(value)}, allowed is {allowed}")

    def has(self, key: str) -> bool:
        """Return whether the key is there; asking makes it known."""
        if key not in self._known:
            self._known.append(key)
        return key in self._values

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
        """Return a text that is not empty."""
        value = self._get(key, default, "a text")
        if not isinstance(value, str) or not value:
            raise self.error(key, value, "a text that is not empty")
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
        good = isinstance(value, list | tuple) and len(value) == size
        if not good or not all(is_number(entry) and least <= entry <= most for entry in value):
            limits = _limits(-math.inf, least, most)
            raise self.error(key, value, f"a list of {size} numbers{limits and ', each' + limits}")
        return np.array(value, float)

    def points(self, key: str, size: int, least: int, most: float = math.inf) -> np.ndarray:
        """Return at least `least` points of `size` numbers from -`most` to `most`, (N, size)."""
        value = self._get(key, REQUIRED, "a list of points")
        rows = value if isinstance(value, list) else []

        def fits(entry: object) -> bool:
            return is_number(entry) and -most <= entry <= most

        good = len(rows) >= least and all(
            isinstance(row, list) and len(row) == size and all(map(fits, row)) for row in rows
        )
        if not good:
            raise self.error(
                key,
                value,
                f"a list of {least} or more [{size} numbers{_limits(-math.inf, -most, most)}]",
            )
        return np.array(value, float)

    def table(self, key: str) -> Table:
        """Return a table below this one."""
        value = self._get(key, REQUIRED, "a table")
        if not isinstance(value, dict):
            raise self.error(key, value, f"a table [{key}]")
        return Table(self.path, f"{self._place}.{key}" if self._place else key, value)

    def tables(self, key: str) -> list[Table]:
        """Return the tables of an array [[key]], none where it is absent."""
        value = self._get(key, [], f"tables [[{key}]]")
        if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
            raise self.error(key, value, f"tables [[{key}]]")
        return [Table(self.path, f"{key}[{i}]", entry) for i, entry in enumerate(value)]

    def close(self) -> None:
        """Refuse every key that nothing asked for."""
        for key in self._values:
            if key not in self._known:
                near = closest(key, self._known)
                hint = f" Did you mean {near!r}?" if near else ""
                where = f"in [{self._place}]" if self._place else "at the top"
                raise ValueError(
                    f"{self.path}: key {shown(key)} {where} is unknown.{hint} "
                    f"Allowed: {', '.join(self._known)}."
                )

    def _get(self, key: str, default: Any, kind: str) -> Any:
        if self.has(key):
            return self._values[key]
        if default is REQUIRED:
            where = f"[{self._place}]" if self._place else "the file"
            raise ValueError(f"{self.path}: {where} has no {key!r}; add it ({kind})")
        return default


def _limits(above: float, least: float, most: float) -> str:
    low = "" if least == -math.inf else f" from {least:g}"
    low = low if above == -math.inf else f" above {above:g}"
    return low + ("" if most == math.inf else f" {'to' if low else 'up to'} {most:g}")


def to_toml(table: Mapping[str, Any], prefix: str = "") -> str:
    """Return `table` as TOML that reads back equal; its own keys come before its subtables."""
    lines = [
        f"{key} = {_value(entry)}\n"
        for key, entry in table.items()
        if not isinstance(entry, Mapping)
    ]
    for key, entry in table.items():
        if isinstance(entry, Mapping):
            inside = to_toml(entry, f"{prefix}{key}.")
            only_tables = entry and all(isinstance(value, Mapping) for value in entry.values())
            head = "" if only_tables else f"\n[{prefix}{key}]\n"
            lines.append(head + inside)
    return "".join(lines)


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(float(value))  # numpy's own floats say their type besides
    if isinstance(value, str):
        # TOML's basic strings take JSON's escapes, except that DEL must be escaped as well.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_value(entry) for entry in value) + "]"
    raise TypeError(f"TOML has no {type(value).__name__}: {value!r}")

"""Tables of a person's TOML file, read key by key; what is wrong is refused by file and key."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from tracks.common.names import closest

_REQUIRED: Any = object()


def read_toml(path: Path) -> Table:
    """Return the whole file as a table.

    Raises:
        ValueError: where there is no such file or it is no TOML, naming the file.
    """
    try:
        text = path.read_text(encoding="utf-8")
        return Table(path, "", tomllib.loads(text))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: is not TOML: {error}") from None


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
        return ValueError(f"{self.path}: {where} is {value!r}, allowed is {allowed}")

    def has(self, key: str) -> bool:
        """Return whether the key is there; asking makes it known."""
        if key not in self._known:
            self._known.append(key)
        return key in self._values

    def number(
        self,
        key: str,
        default: float = _REQUIRED,
        above: float = -math.inf,
        most: float = math.inf,
    ) -> float:
        """Return a finite number greater than `above` and not greater than `most`."""
        value = self._get(key, default, "a number")
        good = _is_number(value) and above < value <= most
        if not good:
            low = "" if above == -math.inf else f" above {above:g}"
            high = "" if most == math.inf else f" up to {most:g}"
            raise self.error(key, value, f"a number{low}{high}")
        return float(value)

    def whole(self, key: str, default: int = _REQUIRED, least: int = 0, most: int = 2**31) -> int:
        """Return a whole number from `least` to `most`."""
        value = self._get(key, default, "a whole number")
        if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
            raise self.error(key, value, f"a whole number from {least} to {most}")
        return value

    def text(self, key: str, default: str = _REQUIRED) -> str:
        """Return a text that is not empty."""
        value = self._get(key, default, "a text")
        if not isinstance(value, str) or not value:
            raise self.error(key, value, "a text that is not empty")
        return value

    def texts(self, key: str) -> list[str]:
        """Return a list of texts, none of them empty."""
        value = self._get(key, _REQUIRED, "a list of texts")
        if not isinstance(value, list) or not all(isinstance(v, str) and v for v in value):
            raise self.error(key, value, "a list of texts that are not empty")
        return value

    def vector(
        self, key: str, size: int, default: Iterable[float] = _REQUIRED, above: float = -math.inf
    ) -> np.ndarray:
        """Return `size` finite numbers, each greater than `above`."""
        value = self._get(key, default, f"{size} numbers")
        good = isinstance(value, list | tuple) and len(value) == size
        if not good or not all(_is_number(entry) and entry > above for entry in value):
            limit = "" if above == -math.inf else f", each above {above:g}"
            raise self.error(key, value, f"a list of {size} numbers{limit}")
        return np.array(value, float)

    def points(self, key: str, size: int, least: int) -> np.ndarray:
        """Return at least `least` points of `size` finite numbers each, (N, size)."""
        value = self._get(key, _REQUIRED, "a list of points")
        rows = value if isinstance(value, list) else []
        good = len(rows) >= least and all(
            isinstance(row, list) and len(row) == size and all(map(_is_number, row)) for row in rows
        )
        if not good:
            raise self.error(key, value, f"a list of {least} or more [{size} numbers]")
        return np.array(value, float)

    def table(self, key: str) -> Table:
        """Return a table below this one."""
        value = self._get(key, _REQUIRED, "a table")
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
                    f"{self.path}: key {key!r} {where} is unknown.{hint} "
                    f"Allowed: {', '.join(self._known)}."
                )

    def _get(self, key: str, default: Any, kind: str) -> Any:
        if self.has(key):
            return self._values[key]
        if default is _REQUIRED:
            where = f"[{self._place}]" if self._place else "the file"
            raise ValueError(f"{self.path}: {where} has no {key!r}; add it ({kind})")
        return default


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)

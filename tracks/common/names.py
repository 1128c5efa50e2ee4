"""Tables of names that other packages may add to, and the error for a name that is in none.

Effects, track families, log formats and worlds are such tables.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar
from unicodedata import category

LONGEST = 80
"""Characters of a name that are looked at, and shown; a file's key may be of megabytes."""


def closest(name: str, allowed: Iterable[str]) -> str | None:
    """Return the entry of `allowed` that `name` was probably meant to be, or None."""
    lowered = {entry.lower(): entry for entry in allowed}
    match = difflib.get_close_matches(name[:LONGEST].lower(), lowered, n=1, cutoff=0.6)
    return lowered[match[0]] if match else None


def printable(text: str, keep: str = "\n\t") -> str:
    """Return a text from elsewhere as it may be printed: control characters as escapes.

    A name or a path may hold what a terminal takes for an order, such as to change its title or to
    type; also what turns the direction of writing, and half characters.
    """
    if text.isprintable():
        return text
    return "".join(
        c.encode("unicode_escape", "surrogatepass").decode()
        if c not in keep and (category(c)[0] == "C" or category(c) in ("Zl", "Zp"))
        else c
        for c in text
    )


def unknown_name(kind: str, name: str, allowed: Iterable[str]) -> ValueError:
    """Return (not raise) the error for `name` where only `allowed` names of `kind` exist.

    The message gives the name, the nearest one or those that hold it, and the whole list.
    """
    allowed = list(allowed)
    near = [guess] if (guess := closest(name, allowed)) else _holding(name, allowed)
    meant = f" Did you mean {', '.join(map(repr, near))}?" if near else ""
    return ValueError(f"unknown {kind} {name[:LONGEST]!r}.{meant} Known: {', '.join(allowed)}.")


def _holding(name: str, allowed: list[str]) -> list[str]:
    """Return those of `allowed` that hold `name` as a part, where they are few."""
    found = [entry for entry in allowed if len(name) > 2 and name.lower() in entry.lower()]
    return found if len(found) < 5 else []


T = TypeVar("T")

PREFIX = "diffracing_suite."
"""Of the entry points' groups of all tables."""


class Registry(Mapping[str, T]):
    """What stands under each name: our own first, then what was added.

    A package adds to it with an entry point of the table's group; a program, for its own process,
    with `register`. Modules are imported, and installed packages asked, when a name is looked up
    that is not there yet or when all are listed, not before.
    """

    def __init__(
        self,
        kind: str,
        group: str,
        own: Mapping[str, Any],
        check: Callable[[str, Any], str | None] = lambda name, value: None,
    ) -> None:
        """Prepare the table.

        Args:
            kind: what an entry is, for people.
            group: of the entry points, such as `diffracing_suite.effects`.
            own: our entries in their order: a value, or where it is as `module` or
                `module:attribute` in a string.
            check: (name, value) -> what is wrong with an added one, None where nothing is.
        """
        self._kind, self._group, self._check = kind, group, check
        self._entries: dict[str, Any] = {
            name: EntryPoint(name, value, group) if isinstance(value, str) else value
            for name, value in own.items()
        }
        self._values: dict[str, T] = {}
        self._complete = False

    def register(self, name: str, value: T) -> None:
        """Add `value` under `name`, for this process.

        Raises:
            ValueError: for a name that is taken, or a value that is no such thing.
        """
        if name in self:
            raise ValueError(f"{self._kind} {name!r} is there already; register another name")
        self._values[name] = self._checked(name, value, "register")
        self._entries[name] = value

    def find(self, name: str) -> T:
        """Return what stands under `name`.

        Raises:
            ValueError: for an unknown name, with the nearest one.
        """
        if name not in self:
            raise unknown_name(self._kind, str(name), self)
        return self[name]

    def __getitem__(self, name: str) -> T:
        value = self._values.get(name)
        return self._load(name) if value is None else value

    def __contains__(self, name: object) -> bool:
        return name in self._entries or name in self._all()

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())

    def _load(self, name: str) -> T:
        entry = self._entries[name] if name in self._entries else self._all()[name]
        value = entry
        if isinstance(entry, EntryPoint):
            try:
                value = entry.load()
            except Exception as error:
                if entry.dist is None:
                    raise
                raise ValueError(
                    f"{self._kind} {name!r} of {_origin(entry)} cannot be loaded "
                    f"({type(error).__name__}: {error}); mend the package or uninstall it"
                ) from error
            if entry.dist is not None:
                self._checked(name, value, _origin(entry))
        self._values[name] = value
        return value

    def _all(self) -> dict[str, Any]:
        if not self._complete:
            added: dict[str, EntryPoint] = {}
            for entry in sorted(_installed().select(group=self._group), key=lambda e: e.name):
                if entry.name in self._entries or entry.name in added:
                    other = _origin(added[entry.name]) if entry.name in added else "the suite"
                    raise ValueError(
                        f"{self._kind} {entry.name!r} of {_origin(entry)} is one of {other} too; "
                        "rename it or uninstall one of the packages"
                    )
                added[entry.name] = entry
            self._entries |= added
            self._complete = True
        return self._entries

    def _checked(self, name: str, value: Any, origin: str) -> Any:
        wrong = self._check(name, value)
        if wrong:
            raise ValueError(f"{self._kind} {name!r} ({origin}): {wrong}")
        return value


def added_entries() -> list[EntryPoint]:
    """Return what installed packages add to any of our tables, in one order."""
    groups = sorted(group for group in _installed().groups if group.startswith(PREFIX))
    return [
        entry
        for group in groups
        for entry in sorted(_installed().select(group=group), key=lambda e: e.name)
    ]


@cache
def _installed() -> Any:
    return entry_points()


def _origin(entry: EntryPoint) -> str:
    return f"the package {entry.dist.name!r} ({entry.value})" if entry.dist else entry.value

"""Registries of named objects, which other packages can extend, and errors for unknown names.

There are registries of effects, sensors, track families, log formats and simulators.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar
from unicodedata import category

from tracks.input.ranges import check_type

LONGEST = 80
"""Largest number of characters of a name that are compared and printed, because a key of a file may
have megabytes."""


def closest(name: str, allowed: Iterable[str]) -> str | None:
    """Return the entry of `allowed` closest to `name`, or None."""
    lowered = {entry.lower(): entry for entry in allowed}
    match = difflib.get_close_matches(name[:LONGEST].lower(), lowered, n=1, cutoff=0.6)
    return lowered[match[0]] if match else None


def printable(text: str, keep: str = "\n\t") -> str:
    """Return a text from an untrusted source for printing, with control characters as escapes.

    Control characters could change a terminal's title or type text. Characters that reverse the
    writing direction and lone surrogates are escaped too.
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
    """Return (not raise) the error for an unknown `name` of `kind`.

    The message has the name, the closest allowed name (or those that contain it), and all allowed
    names.
    """
    allowed, name = list(allowed), str(name)  # a program may give anything as a name
    similar = [guess] if (guess := closest(name, allowed)) else _containing(name, allowed)
    hint = f" Did you mean {', '.join(map(repr, similar))}?" if similar else ""
    return ValueError(f"unknown {kind} {name[:LONGEST]!r}.{hint} Known: {', '.join(allowed)}.")


def name_problem(name: str) -> str | None:
    """Return why `name` cannot stand in files and lists on the command line, or None."""
    if re.fullmatch(r"[A-Za-z0-9_-]+", name):
        return None
    return "its name is written into files; allowed are letters without accents, digits, _ and -"


def _containing(name: str, allowed: list[str]) -> list[str]:
    """Return the entries of `allowed` that contain `name`, if they are fewer than five."""
    matches = [entry for entry in allowed if len(name) > 2 and name.lower() in entry.lower()]
    return matches if len(matches) < 5 else []


T = TypeVar("T")

PREFIX = "diffracing_suite."
"""Prefix of the entry point groups of all registries."""


class Registry(Mapping[str, T]):
    """A mapping from names to objects: those of the suite first, then added ones.

    Another package adds an entry with a Python entry point of the registry's group. A program adds
    one for its own process with `register`. Modules and entry points are loaded only when a name is
    looked up or all names are listed.
    """

    def __init__(
        self,
        kind: str,
        group: str,
        own: Mapping[str, Any],
        check: Callable[[str, Any], str | None] = lambda name, value: None,
    ) -> None:
        """Make the registry.

        The kind of entry is for messages. `group` is an entry point group, such as
        `diffracing_suite.effects`. The suite's `own` entries are values, or texts `module` or
        `module:attribute` from which they are imported. `check` (name, value) returns what is wrong
        with an added entry; None if it is valid. The name of an added entry is checked before.
        """
        self._kind, self._group, self._check = kind, group, check
        self.own = frozenset(own)
        """Names of the suite's own entries, which are not checked."""
        self._entries: dict[str, Any] = {
            name: EntryPoint(name, value, group) if isinstance(value, str) else value
            for name, value in own.items()
        }
        self._values: dict[str, T] = {}
        self._complete = False

    def register(self, name: str, value: T) -> None:
        """Add `value` under `name`, for this process.

        Raises:
            ValueError: for a name that exists or is no text, or a value of the wrong kind.
        """
        check_type(f"{self._kind} (register)", name, (str,), "a name, as a text")
        if name in self:
            restart = "" if name in self.own else ", or restart the program (the notebook's kernel)"
            raise ValueError(
                f"{self._kind} {name!r} exists already; register another name{restart}"
            )
        self._values[name] = self._checked(name, value, "register")
        self._entries[name] = value

    def find(self, name: str) -> T:
        """Return the entry `name`.

        Raises:
            ValueError: for an unknown name; the message has the closest known name.
        """
        check_type(self._kind, name, (str,), "a name, as a text")
        if name not in self:
            error = unknown_name(self._kind, name, self)
            raise ValueError(f"{error} Another one comes with its package: install that first.")
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
        """Return the entry `name`, imported and checked if it is an entry point."""
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
                    f"({type(error).__name__}: {error}); repair the package or uninstall it"
                ) from error
            if entry.dist is not None:
                self._checked(name, value, _origin(entry))
        self._values[name] = value
        return value

    def _all(self) -> dict[str, Any]:
        """Return all entries, with those of other packages; refuse two entries of one name."""
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
        try:
            problem = name_problem(name) or self._check(name, value)
        except Exception as error:  # an attribute of another package may be anything
            problem = f"cannot be checked ({type(error).__name__}: {error})"
        if problem:
            raise ValueError(f"{self._kind} {name!r} ({origin}): {problem}")
        return value


def added_entries() -> list[EntryPoint]:
    """Return the entry points of installed packages for all registries, sorted."""
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

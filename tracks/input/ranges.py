"""Declare the allowed range of each setting in its annotation, and check a configuration.

A field of a configuration dataclass has its range in its annotation:

    rate: Annotated[float, Range(0.0, 10.0)] = 2e-3

`check_ranges` checks a dataclass and all nested dataclasses. If an annotation contains a name (that
of a command line option, for example), messages use that name instead of the field's.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, TypeGuard, get_args, get_origin, get_type_hints


@dataclass(frozen=True)
class Range:
    """The allowed interval of a number, or of each number of a tuple."""

    low: float
    """Lower bound; it is allowed unless `above` is true."""
    high: float
    """Upper bound; it is allowed unless `below` is true. An infinite bound allows infinity."""
    above: bool = False
    """Whether values must be greater than `low`."""
    below: bool = False
    """Whether values must be less than `high`."""
    ordered: bool = False
    """Whether a tuple's numbers must not decrease, as in a range from low to high."""
    whole: bool = False
    """Whether only whole numbers are allowed; `_fields` takes it and the next from the type."""
    size: Any = None
    """Number of a tuple's numbers, `...` for any; None where the value is a single number."""

    def holds(self, value: float) -> bool:
        """Return whether `value` is allowed; NaN is not."""
        above_low = self.low < value if self.above else self.low <= value
        return above_low and (value < self.high if self.below else value <= self.high)

    def of_kind(self) -> str:
        """Return a text of the allowed type and interval."""
        number = "whole number" if self.whole else "number"
        if self.size is None:
            return f"a {number}, {self}"
        count = "" if self.size is ... else f"{self.size} "
        return f"a tuple of {count}{number}s, each {self}"

    def __str__(self) -> str:
        first = f"above {_number(self.low)}" if self.above else _number(self.low)
        if math.isinf(self.high):
            return f"{first} and more, inf included"
        return f"{first} {'to below' if self.below else 'to'} {_number(self.high)}"


SEED_MOST = 2**32 - 1
"""Largest seed."""
Seed = Annotated[int, Range(0, SEED_MOST)]
"""A seed of a random generator."""
Share = Annotated[float, Range(0.0, 1.0)]
"""A fraction from 0 to 1."""
Iterations = Annotated[int, Range(1, 10**9)]
"""A number of iterations."""
Trials = Annotated[int, Range(1, 100_000)]
"""A number of trials or flights."""
TimeLimit = Annotated[float, Range(0.0, 3600.0, above=True)]
"""Time limit of a trial [s]."""


def check_type(name: str, value: object, kinds: tuple[Any, ...], allowed: str) -> None:
    """Refuse an argument that is of none of these types.

    Raises:
        ValueError: with the argument's name, its value and what is allowed.
    """
    if not isinstance(value, kinds) or isinstance(value, bool) and bool not in kinds:
        raise ValueError(f"{name} is {shown(value)}, allowed is {allowed}")


PATH = (str, os.PathLike)
"""Types of a path."""


def as_path(name: str, value: object, allowed: str = "a text or a path") -> Path:
    """Return the argument `name` as a path; `~` at its start is the user's folder.

    Raises:
        ValueError: for an argument that is neither a text nor a path, or is empty.
    """
    check_type(name, value, PATH, allowed)
    if value == "":
        raise ValueError(f"{name} is '', allowed is {allowed}")
    return Path(os.path.expanduser(value))  # pyrefly: ignore[no-matching-overload]


def check_ranges(config: Any, where: str = "", options: bool = False) -> None:
    """Refuse numbers outside their fields' ranges.

    Nested dataclasses are checked as well. `where` is the prefix of fields in messages; with
    `options` they are command line options (`--deadline-s` for `deadline_s`).

    Raises:
        ValueError: naming the field, its value and what is allowed.
    """
    for path, value, allowed in ranged(config):
        name = f"--{path[-1].replace('_', '-')}" if options else where + ".".join(path)
        ends = value if isinstance(value, tuple) else (value,)
        text = " ".join(map(shown, ends)) if options else shown(value)
        size = len(ends) if isinstance(value, tuple) else None
        if size != allowed.size and (size is None or allowed.size is not ...):
            raise ValueError(f"{name} is {text}, allowed is {allowed.of_kind()}")
        for end in ends:
            check_number(name, end, allowed, text)
        if allowed.ordered and list(ends) != sorted(ends):
            raise ValueError(f"{name} is {text}; give the lower end of the range first")


def check_number(name: str, value: Any, allowed: Range, text: str = "") -> None:
    """Refuse a value that is no number, or outside its range.

    Raises:
        ValueError: with the name, the value, or `text` in its place, and what is allowed.
    """
    kind: Any = Integral if allowed.whole else Real
    right = isinstance(value, kind) and not isinstance(value, bool)
    if right and allowed.holds(value):
        return  # the texts below take longer than the check
    allowed_text = str(allowed) if right else allowed.of_kind()
    raise ValueError(f"{name} is {text or shown(value)}, allowed is {allowed_text}")


def ranged(config: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any, Range]]:
    """Yield (path, value, range) of every number with a range, also in nested dataclasses."""
    for name, display_name, allowed, optional in _fields(type(config)):
        value = getattr(config, name)
        if dataclasses.is_dataclass(value):
            yield from ranged(value, (*path, display_name))
        elif allowed is not None and not (optional and value is None):
            yield (*path, display_name), value, allowed


def is_finite(value: float) -> bool:
    """Return whether a number is finite as a float; an int of hundreds of digits is not."""
    try:
        return math.isfinite(value)
    except OverflowError:
        return False


def is_number(value: object) -> TypeGuard[float]:
    """Return whether a value is a finite number, numpy's included; true and false are not."""
    known: Any = value
    return isinstance(value, Real) and not isinstance(value, bool) and is_finite(known)


def shown(value: object) -> str:
    """Return a value for a message; a long one is shortened."""
    try:
        text = repr(value)
    except ValueError:  # Python refuses to print numbers of more than 4300 digits
        return "a number of thousands of digits"
    return text if len(text) <= 80 else f"{text[:40]}… ({len(text)} characters)"


@functools.cache
def _fields(cls: type) -> tuple[tuple[str, str, Range | None, bool], ...]:
    """Return (name, name in messages, range, whether it may be None) of a dataclass's fields."""
    hints = get_type_hints(cls, include_extras=True)
    fields = []
    for field in dataclasses.fields(cls):
        types = list(_types(hints[field.name]))
        metadata = [entry for part in types for entry in getattr(part, "__metadata__", ())]
        allowed = next((entry for entry in metadata if isinstance(entry, Range)), None)
        if allowed:
            parts = next((get_args(part) for part in types if get_origin(part) is tuple), None)
            whole = allowed.whole if float in types else int in types
            size = parts and (... if ... in parts else len(parts))
            allowed = dataclasses.replace(allowed, whole=whole, size=size)
        names = (getattr(entry, "name", None) for entry in metadata)
        display_name = next((name for name in names if isinstance(name, str)), field.name)
        fields.append((field.name, display_name, allowed, NoneType in types))
    return tuple(fields)


def _types(hint: Any) -> Iterator[Any]:
    """Yield the types of which a type is made."""
    yield hint
    for part in get_args(hint):
        yield from _types(part)


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.10g}"

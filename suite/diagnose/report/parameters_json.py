"""A named effect's parameters as JSON, and as lines for people."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.estimate.parameters import ParameterSpace
from tracks.common.grid import Cell, Grid

UNSEEN = "not identifiable"
"""Shown in place of a value that no flight identifies."""


class Component(NamedTuple):
    """One number of a named effect, for people."""

    label: str
    """Parameter, axis and unit."""
    value: float | None
    ci95: tuple[float, float] | None
    neutral: float | None
    """The value with which nothing acts, where it is the same for every vehicle."""

    @property
    def found(self) -> bool:
        """Whether there is a value that is not the neutral one, as far as its interval shows."""
        if self.value is None or self.ci95 is None or self.neutral is None:
            return self.value is not None
        return not self.ci95[0] <= self.neutral <= self.ci95[1]

    def shown(self) -> tuple[str, str]:
        """Return the value and its interval, in as many digits as the interval supports."""
        if self.value is None:
            return UNSEEN, ""
        if self.ci95 is None:
            return f"{self.value:.4g}", ""
        numbers = (self.value, *self.ci95)
        value, low, high = (in_digits(number, numbers) for number in numbers)
        if not self.found:
            value = f"not different from {self.neutral:g}"
        return value, f"{low} to {high}"


def in_digits(number: float, interval: Sequence[float]) -> str:
    """Return `number` with two significant digits of half the width of (value, low, high)."""
    half, size = 0.5 * (interval[2] - interval[1]), max(abs(n) for n in interval)
    if half <= 0.0 or not np.isfinite(half):
        return f"{number:.4g}"
    last = int(np.floor(np.log10(half) + 1e-6)) - 1
    if size < 1e-3 or last > 0:
        return f"{number:.{max(int(np.floor(np.log10(size))) - last, 0)}e}" if size else "0"
    return f"{number:.{-last}f}"


def components(effect: Mapping[str, Any]) -> Iterator[Component]:
    """Yield every number of a named `effect`, an entry of diagnosis.json."""
    known = EFFECTS[effect["name"]].parameters if effect["name"] in EFFECTS else ()
    neutrals = {p.name: p.neutral for p in known if not callable(p.neutral)}
    one_at_a_time = {p.name for p in known if p.one_at_a_time}
    for name, entry in effect["parameters"].items():
        value, span, unit = entry["value"], entry["ci95"], entry["unit"]
        neutral = neutrals.get(name)
        if name == "index" and one_at_a_time:
            # Of several motors each has a line of its own, which says which.
            if not isinstance(value, list):
                sure = span is None or span[0] == span[1]
                yield Component(name, *_one(value, None if sure else span), None)
            continue
        if not isinstance(value, list):
            yield Component(f"{name} [{unit}]", *_one(value, span), neutral)
            continue
        which = effect["parameters"].get("index", {}).get("value")
        axes = "xyz" if len(value) <= 3 else range(1, len(value) + 1)
        if name in one_at_a_time and isinstance(which, list):
            axes = which
        for k, one in enumerate(value):
            between = span[k] if span else None
            yield Component(f"{name} {axes[k]} [{unit}]", *_one(one, between), neutral)


def _one(
    value: float | None, span: Sequence[float] | None
) -> tuple[float | None, tuple[float, float] | None]:
    return value, None if span is None else (float(span[0]), float(span[1]))


def parameters_json(
    space: ParameterSpace,
    name: str,
    indices: Sequence[int],
    theta: np.ndarray,
    half_width: Mapping[int, float],
    undecided: Sequence[int] = (),
) -> dict[str, Any]:
    """Return the parameters of the effect `name` as diagnosis.json has them.

    Args:
        space: of the vehicle.
        name: of the effect.
        indices: places of its numbers that were fitted, in order.
        theta: (P,) all numbers.
        half_width: of the 95 % intervals, by place.
        undecided: places of its numbers that could stand in place of a fitted one.
    """

    def one(index: int) -> tuple[float, list[float]]:
        entry = space.entries[index]
        value, width = float(theta[index]), half_width[index]
        return value, [max(value - width, entry.low), min(value + width, entry.high)]

    found: dict[str, Any] = {}
    for parameter in EFFECTS[name].parameters:
        if parameter.one_at_a_time:
            values = [one(i) for i in indices]
            which = [_number(space, i) for i in indices]
            lone = len(which) == 1
            could = [*which, *(_number(space, i) for i in undecided)]
            spans = [[min(could), max(could)]] if lone else [[k, k] for k in which]
            found["index"] = {
                "value": which[0] if lone else which,
                "unit": "1",
                "ci95": spans[0] if lone else spans,
            }
            found[parameter.name] = {
                "value": values[0][0] if lone else [v for v, _ in values],
                "unit": parameter.unit,
                "ci95": values[0][1] if lone else [c for _, c in values],
            }
            continue
        at = {space.entries[i].component: i for i in indices
              if space.entries[i].parameter == parameter.name}  # fmt: skip
        if not at:
            continue
        if parameter.size:
            parts = [one(at[k]) if k in at else (None, None) for k in range(parameter.size)]
            value, ci = [v for v, _ in parts], [c for _, c in parts]
        else:
            value, ci = one(at[None])
        found[parameter.name] = {"value": value, "unit": parameter.unit, "ci95": ci}
    return found


def _number(space: ParameterSpace, index: int) -> int:
    return (space.entries[index].component or 0) + 1


def cells(*texts: str) -> list[Cell]:
    """Return a row of cells without a tone."""
    return [Cell(text) for text in texts]


def grid(title: str, headers: Sequence[str], rows: Iterable[Sequence[str]], note: str = "") -> Grid:
    """Return a table of plain texts."""
    return Grid(title, headers, [cells(*row) for row in rows], note=note)


def short_name(name: str) -> str:
    """Return a log's name without its folders."""
    return name.replace("\\", "/").rsplit("/", 1)[-1]

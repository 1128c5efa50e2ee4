"""Fitted numbers as those of a vehicle file: values, intervals, and what was left as it was."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from suite.diagnose.identify.fit import Z95, Fitted


class Number(NamedTuple):
    """One entry of a vehicle file, with what the flights say of it."""

    key: str
    """As in the file, with a dot between table and key."""
    unit: str
    value: list[float]
    ci95: list[tuple[float, float] | None]
    """Of each component; None where it was left as it was."""
    follows: bool = False
    """Not told and in the file all the same: a sum was told, and this is what the rest leaves."""

    @property
    def is_told(self) -> bool:
        """Whether flights tell any component."""
        return any(span is not None for span in self.ci95)

    @property
    def is_entered(self) -> bool:
        """Whether the file has it from these flights."""
        return self.is_told or self.follows


Derived = Callable[[Mapping[str, float]], np.ndarray]
"""Values of a file's entry from the fit's numbers."""


def told(fitted: Fitted) -> dict[str, float]:
    """Return all numbers of a fit by name."""
    return {u.name: float(v) for u, v in zip(fitted.unknowns, fitted.value, strict=True)}


def number(
    key: str,
    unit: str,
    fitted: Fitted,
    derived: Derived,
    needs: Sequence[Sequence[str]],
    room: float = np.inf,
) -> Number:
    """Return an entry of the file, its intervals from the fit's by the slopes of `derived`.

    Args:
        key: of the file.
        unit: of the values.
        fitted: the fit.
        derived: the values.
        needs: for each value, the numbers of which one at least must have been told.
        room: a value whose interval reaches further than this to either side is not told, and
            follows what else its numbers tell.
    """
    names = [unknown.name for unknown in fitted.unknowns]
    value = np.atleast_1d(derived(told(fitted)))
    slopes = np.zeros((len(value), len(names)))
    for k, unknown in enumerate(fitted.unknowns):
        up, down = told(fitted), told(fitted)
        up[unknown.name] += unknown.step
        down[unknown.name] -= unknown.step
        change = np.atleast_1d(derived(up)) - np.atleast_1d(derived(down))
        slopes[:, k] = change / (2.0 * unknown.step)
    half = Z95 * np.sqrt(np.maximum(np.einsum("vi,ij,vj->v", slopes, fitted.covariance, slopes), 0))
    seen = [any(fitted.has(name) for name in need if name in names) for need in needs]
    spans = [
        (float(v - h), float(v + h)) if there and h <= room else None
        for v, h, there in zip(value, half, seen, strict=True)
    ]
    follows = any(there and span is None for there, span in zip(seen, spans, strict=True))
    return Number(key, unit, [float(v) for v in value], spans, follows)


def as_json(numbers: Sequence[Number]) -> dict[str, Any]:
    """Return the told entries for JSON: a plain value where there is one component."""
    found = {}
    for entry in numbers:
        if not entry.is_told:
            continue
        one = len(entry.value) == 1
        spans = [None if span is None else list(span) for span in entry.ci95]
        found[entry.key] = {
            "value": entry.value[0] if one else entry.value,
            "unit": entry.unit,
            "ci95": spans[0] if one else spans,
        }
    return found

"""A named effect's parameters as JSON, and as lines for people."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.fit.parameters import ParameterSpace


def components(parameters: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield label, value and interval of every component, None where there is none."""
    for name, entry in parameters.items():
        value, span, unit = entry["value"], entry["ci95"], entry["unit"]
        if not isinstance(value, list):
            yield f"{name} [{unit}]", value, span
            continue
        for k, one in enumerate(value):
            yield f"{name} {k + 1} [{unit}]", one, span[k] if span else None


def in_digits(value: float | None, span: Sequence[float] | None) -> tuple[str, str]:
    """Return a component's value and its interval as cells show them."""
    between = "" if span is None else f"{span[0]:.4g} to {span[1]:.4g}"
    return "not seen" if value is None else f"{value:.4g}", between


def parameters_json(
    space: ParameterSpace,
    name: str,
    indices: Sequence[int],
    theta: np.ndarray,
    half_width: Mapping[int, float],
) -> dict[str, Any]:
    """Return the parameters of the effect `name` as diagnosis.json has them.

    Args:
        space: of the vehicle.
        name: of the effect.
        indices: places of its numbers that were fitted, in order.
        theta: (P,) all numbers.
        half_width: of the 95 % intervals, by place.
    """

    def one(index: int) -> tuple[float, list[float]]:
        entry = space.entries[index]
        value, width = float(theta[index]), half_width[index]
        return value, [max(value - width, entry.low), min(value + width, entry.high)]

    found: dict[str, Any] = {}
    for parameter in EFFECTS[name].parameters:
        if parameter.one_at_a_time:
            values = [one(i) for i in indices]
            which = [(space.entries[i].component or 0) + 1 for i in indices]
            lone = len(which) == 1
            found["index"] = {"value": which[0] if lone else which, "unit": "1", "ci95": None}
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

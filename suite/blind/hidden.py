"""How strong what a case hides is, and the vehicle that has it."""

from __future__ import annotations

from typing import Any

import numpy as np

from eval.effects import EFFECTS, all_values
from eval.vehicles.vehicle import Vehicle
from suite.blind.oracle.strength import columns_in_table, detectable_along

INSIDE = 0.98
"""Share of the way to a physical bound that a strength may go."""


def draw_change(
    rng: np.random.Generator,
    nominal: Vehicle,
    sensors: str,
    effect: str,
    multiple: float,
) -> tuple[np.ndarray, float]:
    """Return the change of each of the effect's columns, and the multiple that came of it.

    The direction is drawn; the strength along it is `multiple` times the detectable one, cut
    where it would pass a physical bound.

    Raises:
        ValueError: where the flights of the table do not show the effect at all.
    """
    columns = columns_in_table(nominal.name, sensors, effect)
    room = np.array([column.room(nominal) for column in columns])
    if columns[0].spec.one_at_a_time:
        alone = np.eye(len(columns))[rng.integers(len(columns))]
        direction = columns[0].spec.signs[0] * alone
    else:
        sign = rng.choice([-1.0, 1.0], len(columns))
        # Where there is no way down from the given value, or none that is usual, it goes up.
        upwards = (room[:, 0] > -1e-9) | np.array([c.spec.upwards(nominal) for c in columns])
        direction = rng.uniform(0.5, 1.0, len(columns)) * np.where(upwards, 1.0, sign)
    unit = detectable_along(nominal.name, sensors, effect, direction)
    if not np.isfinite(unit):
        raise ValueError(
            f"{effect} cannot be seen on vehicle {nominal.name!r} with sensors {sensors!r}; "
            "draw another vehicle or other sensors"
        )
    change = multiple * unit * direction
    limit = INSIDE * np.where(change > 0.0, room[:, 1], room[:, 0])
    moving = np.abs(change) > 0.0
    cut = float(np.min(np.abs(limit[moving] / change[moving]), initial=1.0))
    return min(cut, 1.0) * change, min(cut, 1.0) * multiple


def changed_values(
    nominal: Vehicle, sensors: str, effect: str, change: np.ndarray, rng: np.random.Generator
) -> Any:
    """Return the effect's values (plain numbers): the given vehicle's plus `change`."""
    given = all_values(nominal)[effect]
    fields = {key: np.array(value, dtype=float) for key, value in given._asdict().items()}
    columns = columns_in_table(nominal.name, sensors, effect)
    for column, step in zip(columns, change, strict=True):
        value = fields[column.parameter]
        value[(column.component,) if value.ndim else ()] += step
    for parameter in EFFECTS[effect].parameters:
        for component in parameter.unseen:
            # Cannot be seen, so it may be anything.
            size = 0.5 * parameter.typical[1]
            fields[parameter.name][component] = rng.uniform(-size, size)
    plain = {k: tuple(v.tolist()) if v.ndim else float(v) for k, v in fields.items()}
    return type(given)(**plain)


def true_parameters(effect: str, values: Any, has_voltage: bool) -> dict[str, Any]:
    """Return what a diagnosis should find: totals, with null for what no flight can tell."""
    found: dict[str, Any] = {}
    for parameter in EFFECTS[effect].told(has_voltage):
        value = getattr(values, parameter.name)
        if parameter.size:
            value = [None if i in parameter.unseen else v for i, v in enumerate(value)]
        found[parameter.name] = value
    return found

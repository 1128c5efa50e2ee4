"""Converts fitted numbers into entries of a vehicle file, and makes the vehicle that has them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from eval.effects import EFFECTS
from eval.effects.interface import bound_value
from eval.vehicles.vehicle import Vehicle
from eval.vehicles.vehicle_check import check_vehicle
from suite.diagnose.identify.drive import (
    KNOWN_MOTORS,
    DrivenVehicle,
    possible_inertia,
    torque_ratios,
)
from suite.diagnose.identify.fit import Z95, Fitted
from suite.diagnose.identify.numbers import DELAY, Number
from tracks.common.figures import with_unit

INERTIAS, DRAGS, GAINS = ([f"{name}_{a}" for a in "xyz"] for name in ("inertia", "drag", "gain"))
"""Names of fitted numbers by axis."""
EFFECTS_TABLE = "effects."
"""Prefix of the key of an effect's parameter."""


class Row(NamedTuple):
    """How an entry of a vehicle file follows from fitted numbers."""

    key: str
    unit: str
    needs: Sequence[str]
    """The fitted number that must be identified, for each value of the entry."""
    formula: Callable[[Mapping[str, float]], ArrayLike] | None = None
    """Function from fitted numbers by name to the value(s); None: those of the driven vehicle."""


def entries_of(driven: DrivenVehicle, fitted: Fitted, log_thrust: float = 0.0) -> list[Number]:
    """Return the entries of a vehicle file that a fit estimates.

    `log_thrust` is the logarithm of the scale of the thrust, from the force fit.
    """
    # Flights show the ratio of torque to inertia about z. The uncertainty of the inertia counts if
    # the inertia is identified; otherwise the inertia is held fixed.
    identified = [name for name in INERTIAS if fitted.identifies(name)]

    def inertia(n: Mapping[str, float]) -> np.ndarray:
        return possible_inertia(driven.vehicle(n).inertia)

    def rate_gain(n: Mapping[str, float]) -> np.ndarray:
        gains = np.asarray(driven.start.controller.rate_gain) * np.exp([n[name] for name in GAINS])
        if driven.drive in KNOWN_MOTORS:
            return gains
        # The effect `thrust_scale` of the file scales the torques as well.
        fits = [fitted.identifies(name) for name in GAINS]
        return np.where(fits, gains / torque_ratios(float(np.exp(log_thrust))), gains)

    def twist(n: Mapping[str, float]) -> float:
        numbers = {name: n[name] for name in (*identified, "yaw")}
        return driven.vehicle({**numbers, "thrust": log_thrust}).rotors.torque_coefficient

    thrust = {
        "pwm": [
            Row("motors.thrust", "N", ("thrust", "thrust")),
            Row("motors.voltage_exponent", "1", ("battery",)),
        ],
        "rotors": [Row("rotors.thrust_coefficient", "N/(rad/s)^2", ("thrust",))],
    }.get(driven.drive, [Row("effects.thrust_scale.scale", "1", ("thrust",))])
    rows = {
        "thrust": thrust,
        "drag_z": [Row("effects.linear_drag.coefficient", "1/s", DRAGS)],
        "inertia_x": [Row("inertia", "kg m^2", INERTIAS, inertia)],
        "yaw": [Row("rotors.torque_coefficient", "N m/(rad/s)^2", ("yaw",), twist)],
        "late": [
            Row("rotors.time_constant", "s", ("lag",), lambda n: n["lag"]),
            # `late` is the sum of lag and delay. The delay in the file keeps the sum.
            Row(DELAY, "s", ("late",), lambda n: n["late"] - n["lag"]),
        ],
        "gain_x": [Row("controller.rate_gain", "1/s", GAINS, rate_gain)],
    }
    names = [name for name in fitted.names if name not in fitted.known]
    return [_entry(driven, fitted, row) for name in rows if name in names for row in rows[name]]


def _entry(driven: DrivenVehicle, fitted: Fitted, row: Row) -> Number:
    """Return an entry whose intervals follow from the fit's covariance."""
    formula = row.formula or (lambda n: _value(driven.vehicle(n), row.key))
    values = np.atleast_1d(formula(fitted.values()))
    # Finite differences of the formula turn the covariance of the fit into that of the values.
    slopes = np.zeros((len(values), len(fitted.unknowns)))
    for k, unknown in enumerate(fitted.unknowns):
        up, down = fitted.values(), fitted.values()
        up[unknown.name] += unknown.step
        down[unknown.name] -= unknown.step
        change = np.atleast_1d(formula(up)) - np.atleast_1d(formula(down))
        slopes[:, k] = change / (2.0 * unknown.step)
    variance = np.einsum("vi,ij,vj->v", slopes, fitted.covariance, slopes)
    half = Z95 * np.sqrt(np.maximum(variance, 0.0))
    # The delay is at least as uncertain as the lag, however exact their sum is.
    widest = fitted.unknowns[fitted.index("late")].max_half_width if row.key == DELAY else np.inf
    known = [fitted.identifies(name) for name in row.needs]
    spans = [
        (float(v - h), float(v + h)) if is_known and h <= widest else None
        for v, h, is_known in zip(values, half, known, strict=True)
    ]
    follows = any(one and span is None for one, span in zip(known, spans, strict=True))
    return Number(row.key, row.unit, values.tolist(), spans, follows)


def _value(vehicle: Vehicle, key: str) -> Any:
    """Return the value of an entry of a vehicle file."""
    table, _, name = key.removeprefix(EFFECTS_TABLE).rpartition(".")
    if key.startswith(EFFECTS_TABLE):
        return getattr(vehicle.effects[table], name)
    return getattr(getattr(vehicle, table), name)


def with_entries(
    vehicle: Vehicle, entries: Iterable[Number]
) -> tuple[Vehicle, list[Number], list[str]]:
    """Enter identified numbers into a vehicle.

    Returned are the vehicle, the entries as its file has them (without a delay of 0), and a line
    for people for each value that had to differ from the fitted one.
    """
    numbers, notes = [], []
    for entry in entries:
        clipped, table = entry, entry.key.rpartition(".")[0]
        if table.startswith(EFFECTS_TABLE):  # only the parameters of effects have limits
            parameter = EFFECTS[table.removeprefix(EFFECTS_TABLE)].parameters[0]
            low, high = (bound_value(end, vehicle) for end in (parameter.low, parameter.high))
            clipped = entry._replace(value=[min(max(v, low), high) for v in entry.value])
        vehicle = with_entry(vehicle, clipped)
        removed = entry.key == DELAY and entry.is_entered and clipped.value == [0.0]
        if not removed:
            numbers.append(clipped)
        for k, span in enumerate(entry.ci95):
            fitted, allowed = entry.value[k], clipped.value[k]
            if span is None or fitted == allowed:
                continue
            component = f"[{k}]" if len(entry.value) > 1 else ""
            given = with_unit(f"{fitted:.4g} ({span[0]:.4g} to {span[1]:.4g})", entry.unit)
            then = "none" if removed else f"{allowed:.4g}, the nearest allowed value"
            notes.append(f"{entry.key}{component}: these flights give {given}; the file has {then}")
    return vehicle, numbers, notes


def with_entry(vehicle: Vehicle, entry: Number) -> Vehicle:
    """Return the vehicle with the values of `entry`, if these flights determine them."""
    table, _, key = entry.key.rpartition(".")
    value: Any = tuple(entry.value) if len(entry.value) > 1 else entry.value[0]
    if not table:  # the inertia, of which one component follows from the others
        return replace(vehicle, **{key: value})
    if not entry.is_entered:
        return vehicle
    if table.startswith(EFFECTS_TABLE):
        name = table.removeprefix(EFFECTS_TABLE)
        effects = {**vehicle.effects, name: EFFECTS[name].values(value)}
        if entry.key == DELAY and value == 0.0:
            del effects[name]
        return replace(vehicle, effects=MappingProxyType(effects))
    return replace(vehicle, **{table: replace(getattr(vehicle, table), **{key: value})})


def with_reachable_speed(vehicle: Vehicle, speeds: Sequence[np.ndarray]) -> Vehicle:
    """Return a vehicle whose rotors are fast enough to hover.

    If `speed_max` is too low, it becomes the 99th percentile of the measured `speeds` (G, 4)
    [rad/s] of all flights; the highest may be an outlier.
    """
    try:
        check_vehicle(vehicle)
    except ValueError:  # with the identified thrust, the largest speed does not suffice to hover
        fastest = float(np.nanpercentile(np.concatenate(speeds), 99.0))
        if fastest > vehicle.rotors.speed_max:
            return replace(vehicle, rotors=replace(vehicle.rotors, speed_max=fastest))
    return vehicle

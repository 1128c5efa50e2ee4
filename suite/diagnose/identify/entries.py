"""Converts fitted numbers into entries of a vehicle file, and makes the vehicle that has them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from eval.effects import EFFECTS
from eval.effects.interface import bound_value
from eval.vehicles.vehicle import Vehicle
from eval.vehicles.vehicle_check import check_vehicle
from suite.diagnose.identify.drive import DrivenVehicle, possible_inertia
from suite.diagnose.identify.fit import Z95, Fitted
from suite.diagnose.identify.numbers import DELAY, Number

Formula = Callable[[Mapping[str, float]], ArrayLike]
"""Function from fitted numbers by name to the value of an entry, or to its values (V,)."""
INERTIAS = ("inertia_x", "inertia_y", "inertia_z")
"""Names of the fitted numbers of the inertia."""
EFFECTS_TABLE = "effects."
"""Prefix of the key of an effect's parameter."""


def entries_of(driven: DrivenVehicle, fitted: Fitted, log_thrust: float = 0.0) -> list[Number]:
    """Return the entries of a vehicle file that a fit estimates.

    `log_thrust` is the logarithm of the scale of the thrust, from the force fit.
    """
    names = [name for name in fitted.names if name not in fitted.known]
    entries, entry = list[Number](), partial(_entry, fitted)
    # Thrust and drag.
    if "thrust" in names and driven.drive == "pwm":
        entries = [
            entry("motors.thrust", "N", lambda n: driven.motor_map(n).thrust, 2 * ["thrust"]),
            entry(
                "motors.voltage_exponent",
                "1",
                lambda n: driven.motor_map(n).voltage_exponent,
                ["battery"],
            ),
        ]
    elif "thrust" in names and driven.drive == "rotors":
        one = entry(
            "rotors.thrust_coefficient",
            "N/(rad/s)^2",
            lambda n: driven.vehicle(n).rotors.thrust_coefficient,
            ["thrust"],
        )
        entries.append(one)
    elif "thrust" in names:
        scale = entry("effects.thrust_scale.scale", "1", lambda n: np.exp(n["thrust"]), ["thrust"])
        entries.append(scale)
    if "drag_z" in names:
        drag = entry(
            "effects.linear_drag.coefficient",
            "1/s",
            lambda n: driven.vehicle(n).effects["linear_drag"].coefficient,
            [f"drag_{axis}" for axis in "xyz"],
        )
        entries.append(drag)
    # Inertia and yaw torque.
    if "inertia_x" in names:
        inertia = entry(
            "inertia", "kg m^2", lambda n: possible_inertia(driven.vehicle(n).inertia), INERTIAS
        )
        entries.append(inertia)
    if "yaw" in names:
        # Flights show the ratio of torque to inertia about z. The uncertainty of the inertia counts
        # if the inertia is identified; otherwise the inertia is held fixed.
        identified = [name for name in INERTIAS if fitted.identifies(name)]

        def twist(n: Mapping[str, float]) -> float:
            numbers = {name: n[name] for name in (*identified, "yaw")}
            return driven.vehicle({**numbers, "thrust": log_thrust}).rotors.torque_coefficient

        entries.append(entry("rotors.torque_coefficient", "N m/(rad/s)^2", twist, ["yaw"]))
    # Lag, delay and gains of the rate loop.
    if "late" in names:
        entries.append(entry("rotors.time_constant", "s", lambda n: n["lag"], ["lag"]))
        # `late` is the sum of lag and delay. The delay is at least as uncertain as the lag, however
        # exact the sum is. The delay in the file keeps the sum.
        widest = fitted.unknowns[fitted.index("late")].max_half_width
        entries.append(entry(DELAY, "s", lambda n: n["late"] - n["lag"], ["late"], widest))
    if "gain_x" in names:
        start, needs = np.asarray(driven.start.controller.rate_gain), [f"gain_{a}" for a in "xyz"]
        gains = entry(
            "controller.rate_gain",
            "1/s",
            lambda n: start * np.exp([n[name] for name in needs]),
            needs,
        )
        entries.append(gains)
    return entries


def _entry(
    fitted: Fitted,
    key: str,
    unit: str,
    formula: Formula,
    needs: Sequence[str],
    widest: float = np.inf,
) -> Number:
    """Return an entry whose intervals follow from the fit's covariance.

    `needs` names for each value the fitted number that must be identified. An identified value
    whose 95 % interval has a half-width above `widest` `follows` (see `Number`).
    """
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
    known = [fitted.identifies(name) for name in needs]
    spans = [
        (float(v - h), float(v + h)) if is_known and h <= widest else None
        for v, h, is_known in zip(values, half, known, strict=True)
    ]
    follows = any(one and span is None for one, span in zip(known, spans, strict=True))
    return Number(key, unit, values.tolist(), spans, follows)


def with_entries(
    vehicle: Vehicle, entries: Iterable[Number]
) -> tuple[Vehicle, list[Number], list[str]]:
    """Enter identified numbers into a vehicle.

    Returns:
        The vehicle, the entries with the values that its file has, and a line for people for each
        value that had to differ from the fitted one. A delay of 0 is removed from the entries.
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
            given = f"{fitted:.4g} ({span[0]:.4g} to {span[1]:.4g}) {entry.unit}"
            then = f"the file has {allowed:.4g}, the nearest allowed value"
            if removed:
                then = "the file has none"
            notes.append(f"{entry.key}{component}: these flights give {given}; {then}")
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

    If its `speed_max` is too low for that, it is replaced by the 99th percentile of the measured
    rotor speeds; the highest speed of a log may be an outlier. `speeds` has one array (G, 4) for
    each flight [rad/s].
    """
    try:
        check_vehicle(vehicle)
    except ValueError:  # with the identified thrust, the largest speed does not suffice to hover
        fastest = float(np.nanpercentile(np.concatenate(speeds), 99.0))
        if fastest > vehicle.rotors.speed_max:
            return replace(vehicle, rotors=replace(vehicle.rotors, speed_max=fastest))
    return vehicle

"""What the fits found, as entries of a vehicle file, and a vehicle with them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from eval.effects import EFFECTS
from eval.effects.interface import at
from eval.vehicles.vehicle import Vehicle
from eval.vehicles.vehicle_check import check_vehicle
from suite.diagnose.identify.drive import Driven, inertia_ratio
from suite.diagnose.identify.fit import Fitted
from suite.diagnose.identify.numbers import DELAY, Derived, Number, number


def inertia_of(vehicle: Vehicle, numbers: Mapping[str, float]) -> np.ndarray:
    """Return the inertia (3,); about z it is scaled as the others where it is not identified."""
    found = np.asarray(vehicle.inertia) * np.exp(inertia_ratio(numbers))
    # No body has more about one axis than about the other two together.
    return np.minimum(found, found.sum() - found)


class _Entries(list[Number]):
    """Entries of a vehicle file from one fit."""

    def __init__(self, fitted: Fitted) -> None:
        super().__init__()
        self.fitted, self.names = fitted, {unknown.name for unknown in fitted.unknowns}

    def add(self, key: str, unit: str, derived: Derived, *needs: str, room: float = np.inf) -> None:
        """Add an entry whose components need these numbers of the fit."""
        self.append(number(key, unit, self.fitted, derived, [(name,) for name in needs], room))


def of_force(driven: Driven, fitted: Fitted) -> list[Number]:
    """Return the entries that the force identifies: motors or rotors, and drag."""
    entries = _Entries(fitted)
    if "thrust" in entries.names and driven.drive == "pwm":
        thrust = lambda n: np.array(driven.motor_map(n).thrust)  # noqa: E731
        exponent = lambda n: np.array([driven.motor_map(n).voltage_exponent])  # noqa: E731
        entries.add("motors.thrust", "N", thrust, "thrust", "thrust")
        entries.add("motors.voltage_exponent", "1", exponent, "battery")
    elif "thrust" in entries.names and driven.drive == "rotors":
        key, unit = "rotors.thrust_coefficient", "N/(rad/s)^2"
        entries.add(key, unit, lambda n: np.array([driven.thrust_coefficient(n)]), "thrust")
    elif "thrust" in entries.names:
        key = "effects.thrust_scale.scale"
        entries.add(key, "1", lambda n: np.array([np.exp(n["thrust"])]), "thrust")
    if "drag_z" in entries.names:
        axes, key = (f"drag_{axis}" for axis in "xyz"), "effects.linear_drag.coefficient"
        entries.add(key, "1/s", lambda n: np.array(driven.drag(n)), *axes)
    return entries


def of_torque(driven: Driven, fitted: Fitted, scale: float, lag_s: float) -> list[Number]:
    """Return the entries that the torque identifies: inertia, yaw torque, lag and delay.

    Args:
        driven: the start.
        fitted: the torque's fit.
        scale: logarithm of the thrust's scale, by the force.
        lag_s: of the rotors, where the fit has none [s].
    """
    entries, vehicle = _Entries(fitted), driven.start
    inertias = ("inertia_x", "inertia_y", "inertia_z")
    if "inertia_x" in entries.names:
        entries.add("inertia", "kg m^2", lambda n: inertia_of(vehicle, n), *inertias)
    if "yaw" in entries.names:
        # Torque per inertia is what is seen. The inertia about z counts as far as it is
        # identified; the rest of it is held fixed.
        turns = [name for name in inertias if fitted.has(name)]

        def twist(n: Mapping[str, float]) -> np.ndarray:
            numbers = {name: n[name] for name in (*turns, "yaw")}
            return np.array([driven.torque_coefficient({**numbers, "thrust": scale})])

        entries.add("rotors.torque_coefficient", "N m/(rad/s)^2", twist, "yaw")
    return [*entries, *of_loop(vehicle, fitted, lag_s)]


def of_loop(vehicle: Vehicle, fitted: Fitted, lag_s: float) -> list[Number]:
    """Return the entries of lag, delay and rate gains, as far as the fit has them."""
    entries = _Entries(fitted)
    if "lag" in entries.names:
        entries.add("rotors.time_constant", "s", lambda n: np.array([n["lag"]]), "lag")
    if "late" in entries.names:
        # It is as uncertain as the lag, however well their sum is identified: the file keeps
        # the sum.
        room = fitted.unknowns[fitted.index("late")].room
        late = lambda n: np.array([n["late"] - n.get("lag", lag_s)])  # noqa: E731
        entries.add(DELAY, "s", late, "late", room=room)
    if "gain_x" in entries.names:
        gain, names = np.asarray(vehicle.controller.rate_gain), [f"gain_{axis}" for axis in "xyz"]
        gains = lambda n: gain * np.exp([n[name] for name in names])  # noqa: E731
        entries.add("controller.rate_gain", "1/s", gains, *names)
    return entries


def enter(vehicle: Vehicle, entries: Iterable[Number]) -> tuple[Vehicle, list[Number], list[str]]:
    """Return the vehicle with what was identified, its entries, and how they differ.

    A delay that flights deny is no entry of the vehicle.
    """
    numbers, notes = [], []
    for entry in entries:
        held = allowed(vehicle, entry)
        vehicle = put(vehicle, held)
        gone = entry.key == DELAY and entry.is_entered and held.value == [0.0]
        if not gone:
            numbers.append(held)
        for k, span in enumerate(entry.ci95):
            was, now = entry.value[k], held.value[k]
            if span is None or was == now:
                continue
            part = f"[{k}]" if len(entry.value) > 1 else ""
            then = "the file has none" if gone else f"the file has {now:.4g}, the nearest it may"
            found = f"{was:.4g} ({span[0]:.4g} to {span[1]:.4g}) {entry.unit}"
            notes.append(f"{entry.key}{part}: these flights give {found}; {then}")
    return vehicle, numbers, notes


def allowed(vehicle: Vehicle, entry: Number) -> Number:
    """Return an entry with the values nearest to its own that a file may hold.

    Its intervals stay those of the flights.
    """
    table, _, _ = entry.key.rpartition(".")
    if not table.startswith("effects."):
        return entry
    parameter = EFFECTS[table.removeprefix("effects.")].parameters[0]
    low, high = at(parameter.low, vehicle), at(parameter.high, vehicle)
    return entry._replace(value=[min(max(v, low), high) for v in entry.value])


def put(vehicle: Vehicle, entry: Number) -> Vehicle:
    """Return the vehicle with what was identified of an `allowed` entry; the rest of it stays."""
    if not entry.is_entered:
        return vehicle
    changed = tuple(entry.value) if len(entry.value) > 1 else entry.value[0]
    table, _, key = entry.key.rpartition(".")
    if table.startswith("effects."):
        name = table.removeprefix("effects.")
        effects = {**vehicle.effects, name: EFFECTS[name].values(changed)}
        if entry.key == DELAY and changed == 0.0:
            del effects[name]
        return replace(vehicle, effects=MappingProxyType(effects))
    if not table:
        return vehicle
    return replace(vehicle, **{table: replace(getattr(vehicle, table), **{key: changed})})


def fast_enough(vehicle: Vehicle, speeds: Sequence[np.ndarray]) -> Vehicle:
    """Return a vehicle that its rotors hold up, as they did in flights with these measured speeds.

    Where its `speed_max` is too low for that it becomes the highest speed of the flights, but for
    one in a hundred, as telemetry may be wild.
    """
    try:
        check_vehicle(vehicle)
    except ValueError:
        fastest = float(np.nanpercentile(np.concatenate(speeds), 99.0))
        if fastest > vehicle.rotors.speed_max:
            return replace(vehicle, rotors=replace(vehicle.rotors, speed_max=fastest))
    return vehicle

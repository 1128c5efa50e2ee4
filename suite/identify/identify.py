"""From flights and a vehicle file to the numbers that the flights tell.

Force and torque are fitted in turn, each with what the other has found, since the rotors' lag acts
in both. Mass is never fitted: scaling it together with inertia and thrust changes no flight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import MotorMap, Vehicle
from suite.identify import force, loop, torque
from suite.identify.drive import MotorGuess, drive_of, motor_thrusts, rotor_thrusts
from suite.identify.fit import Fitted
from suite.identify.grid import FlightGrid, grid_of
from suite.identify.numbers import Number, number, told

ROUNDS = 2
"""Force and torque in turn."""
KNOWN_MOTORS = ("rotors", "pwm")
"""Drives under which the rotors' thrusts are known beside the commands."""
NO_LAG_S = 0.004
"""A rotor's lag below this is not believed where the start has a longer one [s]."""
WHY = {
    "thrust": "thrust: too little of the force along body z is explained",
    "curve": "curvature of the thrust curve: the motor commands hardly change",
    "battery": "voltage_exponent: the voltage hardly changes",
    "drag_x": "drag along body x: too slow, or too little of it",
    "drag_y": "drag along body y: too slow, or too little of it",
    "drag_z": "drag along body z: too slow, or too little of it",
    "inertia_x": "inertia about x: the body hardly rolls",
    "inertia_y": "inertia about y: the body hardly pitches",
    "inertia_z": "inertia about z: the body hardly yaws",
    "yaw": "torque_coefficient: the body hardly yaws",
    "lag": "time_constant of the rotors: nothing fast enough is asked of them",
    "late": "command_delay: nothing fast enough is asked of the motors",
    "gain_x": "rate_gain about x: the body hardly rolls",
    "gain_y": "rate_gain about y: the body hardly pitches",
    "gain_z": "rate_gain about z: the body hardly yaws",
}
"""What was not told, and what the flights lack for it."""


@dataclass(frozen=True)
class Identified:
    """What flights say of a vehicle."""

    vehicle: Vehicle
    """The start with the numbers that were told."""
    numbers: tuple[Number, ...]
    """All that were looked for."""
    untold: tuple[str, ...]
    """What these flights cannot tell, in words; it was left as it was."""
    drive: str
    """What drove the flights: pwm, rotors, torques or rates."""
    left: dict[str, list[float]]
    """Root mean square of what is left of force per mass and angular acceleration, per axis."""
    flights: tuple[str, ...]
    """Names of those that were used."""


def identify(logs: Sequence[FlightLog], vehicle: Vehicle, leave: Sequence[str] = ()) -> Identified:
    """Return the numbers of `vehicle` that `logs` tell.

    Args:
        logs: flights of one vehicle.
        vehicle: to start from; what cannot be told stays as it is there.
        leave: what not to fit: any of drag, motors, inertia, lag, loop.

    Raises:
        ValueError: where the flights share no drive, or hold nothing that can be compared.
    """
    flights = [grid_of(log) for log in logs]
    drive = drive_of(flights)
    state = _Start(flights, vehicle, drive, tuple(leave))
    if drive not in KNOWN_MOTORS:
        state.loop()
    for _ in range(ROUNDS):
        state.force()
        state.torque()
    if drive in KNOWN_MOTORS:
        state.loop()
    return state.done()


class _Start:
    """What is known so far; each fit starts from what the one before has found."""

    def __init__(
        self, flights: list[FlightGrid], vehicle: Vehicle, drive: str, leave: tuple[str, ...]
    ) -> None:
        self.flights, self.start, self.drive, self.leave = flights, vehicle, drive, leave
        self.guess = MotorGuess(0.0, 0.0, 0.0, 1.0, 1.0)
        if drive == "pwm":
            self.start = with_motors(flights, vehicle)
            self.guess = _guess(flights, self.start)
        self.lag_s = _value(vehicle, "motor_lag", "time_constant", vehicle.rotors.time_constant)
        self.delay_s = _value(vehicle, "command_delay", "delay", 0.0)
        self.drag = np.asarray(_value(vehicle, "linear_drag", "coefficient", (0.0,) * 3), float)
        self.begun_s = self.lag_s
        self.fitted: dict[str, Fitted] = {}
        self.scale = 0.0

    def force(self) -> None:
        flights = [f for f in self.flights if f.has("rot_w") and f.has("pos_w")]
        if not flights:
            return
        voltage = all(flight.has("voltage") for flight in flights)
        unknowns = force.unknowns_of(self.drive, self.guess, voltage, self.drag.tolist())
        left = {"drag": ("drag_",), "motors": ("thrust", "curve", "battery")}
        unknowns = _without(unknowns, left, self.leave)
        told_drag = {f"drag_{a}": d for a, d in zip("xyz", self.drag, strict=True)}
        if not unknowns:
            return
        found = force.fit_force(
            flights,
            self.start,
            self.drive,
            self.guess,
            unknowns,
            self.lag_s,
            self.delay_s,
            told_drag,
        )
        self.fitted["force"] = found
        self.scale = told(found).get("thrust", 0.0)

    def thrusts(self, flight: FlightGrid, lag_s: float, delay_s: float) -> np.ndarray:
        scale = float(np.exp(self.scale))
        if self.drive == "rotors":
            return scale * rotor_thrusts(flight, self.start.rotors.thrust_coefficient)
        numbers = told(self.fitted["force"]) if "force" in self.fitted else {}
        guess = force.with_told(self.guess, numbers)
        return scale * motor_thrusts(flight, guess, lag_s, delay_s)

    def torque(self) -> None:
        flights = [flight for flight in self.flights if flight.has("rate_b")]
        if self.drive == "rates" or not flights:
            return
        unknowns = torque.unknowns_of(self.drive, self.lag_s, self.delay_s)
        left = {"inertia": ("inertia_", "yaw"), "lag": ("lag", "late")}
        unknowns = _without(unknowns, left, self.leave)
        if not unknowns:
            return
        given = self.lags()
        found = torque.fit_torque(flights, self.start, self.drive, unknowns, self.thrusts, given)
        if found.has("lag") and told(found)["lag"] < NO_LAG_S < self.begun_s:
            # No rotor follows at once: what blurs the commands in the log hides its lag.
            unknowns = [unknown for unknown in unknowns if unknown.name != "lag"]
            given = {**given, "lag": self.begun_s}
            found = torque.fit_torque(
                flights, self.start, self.drive, unknowns, self.thrusts, given
            )
            found = replace(found, untold=(*found.untold, "lag"))
            self.lag_s = self.begun_s
        self.keep("torque", found)

    def loop(self) -> None:
        """Fit the nominal rate loop, and measured rotor speeds behind commanded ones."""
        both = torque.lag_and_delay(self.lag_s, self.delay_s)
        commanded = [f for f in self.flights if f.has("rotor_speed", "rotor_speed_cmd")]
        if commanded and "lag" not in self.leave:
            self.keep("rotors", torque.fit_rotor_lag(commanded, both))
        flown = [f for f in self.flights if f.has("rate_b", "rate_cmd_b")]
        if not flown or self.start.controller.kind != "p" or "loop" in self.leave:
            return
        # Lag and delay of known motors are told better by the torque.
        known = "rotors" in self.fitted or self.drive == "pwm" or "lag" in self.leave
        unknowns = [*loop.gains(), *([] if known else both)]
        self.keep("loop", loop.fit_loop(flown, self.start, unknowns, self.lags()))

    def lags(self) -> dict[str, float]:
        return {"lag": self.lag_s, "late": self.lag_s + self.delay_s}

    def keep(self, name: str, found: Fitted) -> None:
        self.fitted[name] = found
        self.lag_s = told(found).get("lag", self.lag_s)
        self.delay_s = told(found).get("late", self.lag_s + self.delay_s) - self.lag_s

    def inertia(self) -> tuple[float, float, float]:
        numbers = told(self.fitted["torque"]) if "torque" in self.fitted else {}
        x, y, z = inertia_of(self.start, numbers)
        return float(x), float(y), float(z)

    def done(self) -> Identified:
        vehicle, numbers = self.start, []
        if "force" in self.fitted:
            numbers += _of_force(self.start, self.drive, self.guess, self.fitted["force"])
        if "torque" in self.fitted:
            numbers += _of_torque(
                self.start, self.drive, self.fitted["torque"], self.scale, self.lag_s
            )
        for name in ("rotors", "loop"):
            if name in self.fitted:
                numbers += _of_loop(self.start, self.fitted[name], self.lag_s)
        kept: dict[str, Number] = {}
        for entry in numbers:
            # What a later fit tells is told better: it sees the rotors themselves.
            if entry.key not in kept or any(span is not None for span in entry.ci95):
                kept[entry.key] = entry
        for entry in kept.values():
            vehicle = _put(vehicle, entry)
        if "torque" in self.fitted and self.drive != "rates":
            vehicle = replace(vehicle, inertia=self.inertia())
        untold = [WHY[name] for found in self.fitted.values() for name in found.untold]
        seen = {entry.key for entry in kept.values() if any(s is not None for s in entry.ci95)}
        untold = [u for u in dict.fromkeys(untold) if not _told_elsewhere(u, seen)]
        left = {
            name: [float(v) for v in self.fitted[name].left]
            for name in ("force", "torque")
            if name in self.fitted
        }
        names = tuple(flight.name for flight in self.flights)
        return Identified(vehicle, tuple(kept.values()), tuple(untold), self.drive, left, names)


def inertia_of(vehicle: Vehicle, numbers: dict[str, float]) -> np.ndarray:
    """Return the inertia (3,); what yaws is scaled as the others where nothing tells it."""
    x, y = (numbers.get(f"inertia_{axis}", 0.0) for axis in "xy")
    z = numbers.get("inertia_z", 0.5 * (x + y))
    return np.asarray(vehicle.inertia) * np.exp([x, y, z])


def motors_of(guess: MotorGuess, numbers: dict[str, float], volts: float) -> np.ndarray:
    """Return t1, t2 [N] and the exponent of `[motors]` at the nominal voltage `volts`."""
    shape = force.with_told(guess, numbers)
    size = shape.size * np.exp(numbers.get("thrust", 0.0))
    per = (volts / shape.volts) ** shape.battery / shape.usual
    first, second = (1.0 - shape.curve) * per, shape.curve * per**2
    return np.array([size * first, size * second, shape.battery])


def _of_force(vehicle: Vehicle, drive: str, guess: MotorGuess, fitted: Fitted) -> list[Number]:
    entries = []
    names = [unknown.name for unknown in fitted.unknowns]
    if "thrust" in names and drive == "pwm":
        assert vehicle.motors is not None
        volts = vehicle.motors.voltage
        entries.append(
            number(
                "motors.thrust",
                "N",
                fitted,
                lambda n: motors_of(guess, n, volts)[:2],
                [("thrust",)] * 2,
            )
        )
        entries.append(
            number(
                "motors.voltage_exponent",
                "1",
                fitted,
                lambda n: motors_of(guess, n, volts)[2:],
                [("battery",)],
            )
        )
    elif "thrust" in names and drive == "rotors":
        start = vehicle.rotors.thrust_coefficient
        entries.append(
            number(
                "rotors.thrust_coefficient",
                "N/(rad/s)^2",
                fitted,
                lambda n: np.array([start * np.exp(n["thrust"])]),
                [("thrust",)],
            )
        )
    elif "thrust" in names:
        entries.append(
            number(
                "effects.thrust_scale.scale",
                "1",
                fitted,
                lambda n: np.array([np.exp(n["thrust"])]),
                [("thrust",)],
            )
        )
    if "drag_x" in names:
        entries.append(
            number(
                "effects.linear_drag.coefficient",
                "1/s",
                fitted,
                lambda n: np.array([n[f"drag_{axis}"] for axis in "xyz"]),
                [(f"drag_{axis}",) for axis in "xyz"],
            )
        )
    return entries


def _of_torque(
    vehicle: Vehicle, drive: str, fitted: Fitted, scale: float, lag_s: float
) -> list[Number]:
    entries = []
    names = [unknown.name for unknown in fitted.unknowns]
    if "inertia_x" in names:
        entries.append(
            number(
                "inertia",
                "kg m^2",
                fitted,
                lambda n: inertia_of(vehicle, dict(n)),
                [("inertia_x",), ("inertia_y",), ("inertia_z",)],
            )
        )
    if "yaw" in names:
        # Torque per inertia is what is seen, and the inertia about z follows those about x and y.
        start = vehicle.rotors.torque_coefficient

        def twist(n: Any) -> np.ndarray:
            follows = 0.5 * (n.get("inertia_x", 0.0) + n.get("inertia_y", 0.0))
            scaled = scale if drive == "rotors" else 0.0
            return np.array([start * np.exp(n["yaw"] + scaled + follows)])

        entries.append(
            number("rotors.torque_coefficient", "N m/(rad/s)^2", fitted, twist, [("yaw",)])
        )
    return [*entries, *_of_loop(vehicle, fitted, lag_s)]


def _of_loop(vehicle: Vehicle, fitted: Fitted, lag_s: float) -> list[Number]:
    entries = []
    names = [unknown.name for unknown in fitted.unknowns]
    if "lag" in names:
        entries.append(
            number("rotors.time_constant", "s", fitted, lambda n: np.array([n["lag"]]), [("lag",)])
        )
    if "late" in names:
        entries.append(
            number(
                "effects.command_delay.delay",
                "s",
                fitted,
                lambda n: np.array([n["late"] - n.get("lag", lag_s)]),
                [("late",)],
            )
        )
    if "gain_x" in names:
        gain = np.asarray(vehicle.controller.rate_gain)
        entries.append(
            number(
                "controller.rate_gain",
                "1/s",
                fitted,
                lambda n: gain * np.exp([n[f"gain_{axis}"] for axis in "xyz"]),
                [(f"gain_{axis}",) for axis in "xyz"],
            )
        )
    return entries


def _put(vehicle: Vehicle, entry: Number) -> Vehicle:
    """Return the vehicle with what was told of an entry; the rest of it stays."""
    if all(span is None for span in entry.ci95):
        return vehicle
    value = tuple(entry.value)
    table, _, key = entry.key.rpartition(".")
    if table.startswith("effects."):
        name = table.removeprefix("effects.")
        effect = EFFECTS[name]
        parameter = effect.parameters[0]
        kept = [max(v, 0.0) for v in value] if name == "linear_drag" else list(value)
        if name == "command_delay" and kept[0] <= 0.0:
            return vehicle
        values = effect.values(tuple(kept) if parameter.size else kept[0])
        return replace(vehicle, effects=MappingProxyType({**vehicle.effects, name: values}))
    if not table:
        return vehicle
    part = getattr(vehicle, table)
    changed = value if len(value) > 1 else value[0]
    return replace(vehicle, **{table: replace(part, **{key: changed})})


def _told_elsewhere(text: str, keys: set[str]) -> bool:
    first = text.split(":")[0].split(" ")[0]
    return any(key.endswith(first) for key in keys)


def with_motors(flights: Sequence[FlightGrid], vehicle: Vehicle) -> Vehicle:
    """Return the vehicle with `[motors]`: full speed at full command where it had none."""
    if vehicle.motors is not None:
        return vehicle
    volts = _volts(flights, 1.0)
    return replace(vehicle, motors=MotorMap((0.0, vehicle.rotors.thrust_max), volts))


def _volts(flights: Sequence[FlightGrid], otherwise: float) -> float:
    have = [f.known["voltage"] for f in flights if f.has("voltage")]
    return float(np.nanmedian(np.concatenate(have))) if have else otherwise


def _guess(flights: Sequence[FlightGrid], vehicle: Vehicle) -> MotorGuess:
    """Return the start's motors about the command and the voltage that are usual here."""
    motors = vehicle.motors
    assert motors is not None
    usual = float(np.nanmedian(np.concatenate([f.known["pwm"].ravel() for f in flights])))
    volts = _volts(flights, motors.voltage)
    first, second = motors.thrust
    v = usual * (volts / motors.voltage) ** motors.voltage_exponent
    size = first * v + second * v**2
    return MotorGuess(size, second * v**2 / size, motors.voltage_exponent, usual, volts)


def _value(vehicle: Vehicle, effect: str, key: str, otherwise: Any) -> Any:
    values = vehicle.effects.get(effect)
    return otherwise if values is None else getattr(values, key)


def _without(
    unknowns: Sequence[Any], names: dict[str, tuple[str, ...]], leave: Sequence[str]
) -> list[Any]:
    out = tuple(start for what in leave for start in names.get(what, ()))
    return [u for u in unknowns if not (out and u.name.startswith(out))]

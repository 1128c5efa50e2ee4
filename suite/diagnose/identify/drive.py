"""The input (drive) of flights, and the accelerations of a vehicle with trial numbers under it.

The equations are those of the plant, as in the views of a diagnosis. Effects of the start vehicle
that scale one of its numbers are merged into that number first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from eval.effects import EFFECTS
from eval.quadrotor.plant import Plant, Wrench, accelerations, make_plant
from eval.vehicles.vehicle import MotorMap, Vehicle, motor_speed
from eval.vehicles.vehicle_check import check_vehicle
from suite.diagnose.data.sampling import LONGEST_S, follow_lag
from suite.diagnose.data.view import FlightRows
from suite.diagnose.evidence.moments import accelerations_on, motion_of
from suite.diagnose.identify.grid import STEP_S, FlightGrid

DRIVES = {
    "rotors": ("rotor_speed",),
    "pwm": ("pwm",),
    "torques": ("thrust_cmd", "torque_cmd_b"),
    "rates": ("thrust_cmd", "rate_cmd_b"),
    "thrust": ("thrust_cmd",),
}
"""Signals by drive; the first that all flights have counts."""


def drive_of(flights: Sequence[FlightGrid]) -> str:
    """Return the name of what drives all of `flights`.

    Raises:
        ValueError: where they share nothing.
    """
    for name, signals in DRIVES.items():
        if all(flight.has(*signals) for flight in flights):
            return name
    raise ValueError(
        "the flights share no drive: every one needs rotor speeds, motor commands (pwm_1 to "
        "pwm_4), or a thrust command; those of another kind can be identified apart"
    )


def with_battery(flights: Sequence[FlightGrid], drive: str) -> list[FlightGrid]:
    """Return the flights with the best known motor thrust.

    It depends on the battery: where some flights have its voltage, the others are left out.
    """
    have = [flight for flight in flights if flight.has("voltage")]
    return have if have and drive == "pwm" else list(flights)


def with_motors(flights: Sequence[FlightGrid], vehicle: Vehicle) -> Vehicle:
    """Return the vehicle with `[motors]`: full speed at full command where it had none.

    Flights without a voltage give them an exponent of 0. The nominal voltage then has no effect;
    it is set to the median voltage of the flights that have one.
    """
    motors = vehicle.motors
    if motors is None:
        exponent = 1.0 if any(flight.has("voltage") for flight in flights) else 0.0
        motors = MotorMap((0.0, vehicle.rotors.thrust_max), 1.0, exponent)
    elif motors.voltage_exponent:
        return vehicle
    return replace(vehicle, motors=replace(motors, voltage=_volts(flights, motors.voltage)))


def _volts(flights: Sequence[FlightGrid], otherwise: float) -> float:
    have = [f.known["voltage"] for f in flights if f.has("voltage")]
    return float(np.nanmedian(np.concatenate(have))) if have else otherwise


@dataclass(frozen=True)
class Driven:
    """A vehicle to start from, and what drives its flights; numbers are by their names.

    Those of motors are about a usual command and voltage: there `thrust` is the logarithm of what
    they give over what the start's do, and `curve` the quadratic part's share.
    """

    start: Vehicle
    drive: str
    """One of `DRIVES`."""
    command: float = 1.0
    """Usual motor command."""
    volts: float = 1.0
    """Usual voltage [V]."""

    @property
    def motors(self) -> MotorMap:
        """The start's motors; none drive flights of another kind."""
        return self.start.motors or MotorMap((0.0, 1.0), 1.0, 0.0)

    @property
    def usual_thrust(self) -> tuple[float, float]:
        """Linear and quadratic part of what the start's motors give as usual [N]."""
        first, second = self.motors.thrust
        applied = self.command * (self.volts / self.motors.voltage) ** self.battery
        return first * applied, second * applied**2

    @property
    def curve(self) -> float:
        """Share of the quadratic part in the start's usual thrust."""
        return self.usual_thrust[1] / sum(self.usual_thrust)

    @property
    def battery(self) -> float:
        """The start's voltage exponent."""
        return self.motors.voltage_exponent

    def motor_map(self, numbers: Mapping[str, float]) -> MotorMap:
        """Return `[motors]` with `numbers`."""
        curve, battery = numbers.get("curve", self.curve), numbers.get("battery", self.battery)
        size = sum(self.usual_thrust) * float(np.exp(numbers.get("thrust", 0.0)))
        per = (self.motors.voltage / self.volts) ** battery / self.command
        thrust = (float(size * (1.0 - curve) * per), float(size * curve * per**2))
        return MotorMap(thrust, self.motors.voltage, float(battery))

    def thrust_coefficient(self, numbers: Mapping[str, float]) -> float:
        """Return that of the rotors, which their measured speeds identify alone."""
        scale = float(np.exp(numbers.get("thrust", 0.0))) if self.drive == "rotors" else 1.0
        return self.start.rotors.thrust_coefficient * scale

    def torque_coefficient(self, numbers: Mapping[str, float]) -> float:
        """Return that of the rotors: `yaw` is of torque about z over the inertia there."""
        scaled = numbers.get("thrust", 0.0) if self.drive == "rotors" else 0.0
        turning = numbers.get("yaw", 0.0) + inertia_ratio(numbers)[2] + scaled
        return self.start.rotors.torque_coefficient * float(np.exp(turning))

    def drag(self, numbers: Mapping[str, float]) -> tuple[float, ...]:
        """Return the linear drag [1/s]."""
        had = self.start.effects.get("linear_drag")
        begun = (0.0, 0.0, 0.0) if had is None else had.coefficient
        return tuple(float(numbers.get(f"drag_{a}", d)) for a, d in zip("xyz", begun, strict=True))

    def plant(self, numbers: Mapping[str, float]) -> Plant:
        """Return the plant with `numbers`, and with all effects of the start that act by state."""
        effects = {n: v for n, v in self.start.effects.items() if EFFECTS[n].by_state}
        effects["linear_drag"] = EFFECTS["linear_drag"].values(self.drag(numbers))
        if self.drive not in KNOWN_MOTORS:
            scale = float(np.exp(numbers.get("thrust", 0.0)))
            effects["thrust_scale"] = EFFECTS["thrust_scale"].values(scale)
        rotors = replace(
            self.start.rotors,
            thrust_coefficient=self.thrust_coefficient(numbers),
            torque_coefficient=self.torque_coefficient(numbers),
        )
        inertia = np.asarray(self.start.inertia) * np.exp(inertia_ratio(numbers))
        vehicle = replace(self.start, rotors=rotors, inertia=_three(inertia), effects=effects)
        return make_plant(vehicle, LONGEST_S)

    def rotor_speed(self, flight: FlightGrid, numbers: Mapping[str, float]) -> np.ndarray:
        """Return the rotors' speeds (G, 4): measured, or by their commands [rad/s].

        Commands come behind `lag`, and behind it and the delay together by `late`.
        """
        known = flight.known
        if self.drive == "rotors":
            return known["rotor_speed"]
        if self.drive == "pwm":
            vehicle = replace(self.start, motors=self.motor_map(numbers))
            volts = np.maximum(known["voltage"], 0.1) if flight.has("voltage") else None
            # The usual voltage counts where none was measured.
            volts = np.full(len(flight.time_s), self.volts) if volts is None else volts
            wanted = motor_speed(vehicle, known["pwm"], volts)
        else:
            each = 0.25 * self.start.mass * np.maximum(known["thrust_cmd"], 0.0)
            wanted = np.sqrt(each / self.start.rotors.thrust_coefficient)[:, None] * np.ones(4)
        return behind(wanted, numbers)

    def acting(
        self,
        flight: FlightGrid,
        rows: FlightRows,
        numbers: Mapping[str, float],
        powered: bool = True,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return dv/dt in the world and dw/dt in body axes (G, 3) on the `rows` of `flight`.

        Rotors stand still where their speed is unknown, or not `powered`.
        """
        plant = self.plant(numbers)
        if powered:
            rows = rows._replace(rotor_speed=np.nan_to_num(self.rotor_speed(flight, numbers)))
        acc_w, turn_b = accelerations_on(plant, rows, flight.has("voltage"))
        if self.drive == "torques":
            torque_b = np.nan_to_num(behind(flight.known["torque_cmd_b"], numbers))
            wrench = Wrench(np.zeros_like(torque_b), torque_b)
            _, turn_b = accelerations(plant, motion_of(plant, rows), wrench)
        return acc_w, turn_b


def driven_by(flights: Sequence[FlightGrid], vehicle: Vehicle, drive: str) -> Driven:
    """Return `vehicle` under what drives `flights`, about what is usual there."""
    if drive != "pwm":
        return Driven(vehicle, drive)
    assert vehicle.motors is not None
    usual = float(np.nanmedian(np.concatenate([f.known["pwm"].ravel() for f in flights])))
    return Driven(vehicle, drive, usual, _volts(flights, vehicle.motors.voltage))


def inertia_ratio(numbers: Mapping[str, float]) -> np.ndarray:
    """Return the logarithms (3,) of the inertia over the start's."""
    x, y, z = (numbers.get(f"inertia_{axis}", 0.0) for axis in "xyz")
    return np.array([x, y, 0.5 * (x + y) + z])


def behind(values: np.ndarray, numbers: Mapping[str, float]) -> np.ndarray:
    """Return held commands (G, C) behind what lies between them and the rotors."""
    lag_s = numbers["lag"]
    return lagged(delayed(values, numbers["late"] - lag_s), lag_s)


def delayed(values: np.ndarray, delay_s: float) -> np.ndarray:
    """Return what held `values` (G, ...) were `delay_s` ago; before the first row, the first.

    A value that holds from one grid point to the next is met half of it later.
    """
    count = len(values)
    place = np.clip(np.arange(count) - delay_s / STEP_S - 0.5, 0.0, count - 1.0)
    row = np.minimum(place.astype(int), max(count - 2, 0))
    part = (place - row).reshape(-1, *[1] * (values.ndim - 1))
    return (1.0 - part) * values[row] + part * values[np.minimum(row + 1, count - 1)]


def lagged(values: np.ndarray, lag_s: float) -> np.ndarray:
    """Return `values` (G, C), joined by lines, behind a first-order lag."""
    if lag_s <= 1e-4:
        return values
    whole = filled(values)
    # The state at a grid point has seen the steps before it, each at its mean.
    before = 0.5 * (np.concatenate([whole[:1], whole[:-1]]) + whole)
    return np.where(np.isfinite(values), follow_lag(before, STEP_S, lag_s), np.nan)


def filled(values: np.ndarray) -> np.ndarray:
    """Return `values` (G, C) with the last known in the place of NaN."""
    good = np.isfinite(values).all(axis=1)
    last = np.maximum.accumulate(np.where(good, np.arange(len(values)), 0))
    first = int(np.argmax(good))
    return np.nan_to_num(values[np.maximum(last, first)])


KNOWN_MOTORS = ("rotors", "pwm")
"""Drives under which the rotors' thrusts are known, and not only commanded."""
OWN = ("motor_lag", "inertia_scale", "rate_gain")
"""Effects that scale or replace a number which is fitted."""
FITTED = ("linear_drag", "blade_flapping", "command_delay", "thrust_scale")
"""Effects that are entries of what is found, and start from where the file has them."""


def with_own_numbers(vehicle: Vehicle, known_motors: bool) -> Vehicle:
    """Return `vehicle` with the numbers that its effects scale or replace, without these.

    It flies as before. Next to the identified number they would count twice.

    Args:
        vehicle: as it was given.
        known_motors: the motors' own thrust is fitted, and no scale of what was commanded, so that
            the effect of that name is one of these as well.

    Raises:
        ValueError: where no file may hold such numbers, as of rotors that are too weak to hover.
    """
    names = (*OWN, "thrust_scale") if known_motors else OWN
    own = {name: values for name, values in vehicle.effects.items() if name in names}
    if not own:
        return vehicle
    rotors, motors = vehicle.rotors, vehicle.motors
    true = make_plant(vehicle, 1.0 / vehicle.controller.frequency, own).constants
    push = float(true.thrust_coefficient[0])
    if motors is not None:
        first, second = np.asarray(motors.thrust) * (push / rotors.thrust_coefficient)
        motors = replace(motors, thrust=(float(first), float(second)))
    rotors = replace(rotors, thrust_coefficient=push, time_constant=float(true.time_constant))
    found = replace(
        vehicle,
        rotors=rotors,
        motors=motors,
        controller=replace(vehicle.controller, rate_gain=_three(true.rate_gain)),
        effects=MappingProxyType({n: v for n, v in vehicle.effects.items() if n not in own}),
    )
    try:
        # The scale of the inertia may be more than a body can have; the fit makes it possible.
        check_vehicle(found)
    except ValueError as error:
        raise ValueError(f"{vehicle.name} with its {', '.join(own)}: {error}") from error
    return replace(found, inertia=_three(true.inertia))


def unknown_to_the_fits(vehicle: Vehicle) -> Sequence[str]:
    """Return the effects of a start that no fit takes into account, and that stay in its file.

    Force and torque model all effects that depend on the state.
    """
    known = (*OWN, *FITTED)
    unknown = {n for n, e in EFFECTS.items() if not e.by_state or e.late is not None}
    return [name for name in vehicle.effects if name in unknown and name not in known]


def _three(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values
    return float(x), float(y), float(z)

"""Models the accelerations of a vehicle from the signals that drive its flights.

The drive is what determines the rotors' thrust: measured rotor speeds, motor commands, or commanded
torques, rates and thrust. The equations are those of the simulated vehicle in `eval/`. G is the
number of times on the grid of a flight (`grid.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from eval.effects import EFFECTS
from eval.quadrotor.loops import NOMINAL
from eval.quadrotor.plant import Wrench, accelerations, make_plant
from eval.vehicles.vehicle import MotorMap, Vehicle, motor_speed
from eval.vehicles.vehicle_check import check_vehicle
from suite.diagnose.data.sampling import follow_lag, hold
from suite.diagnose.data.steps import LONGEST_S
from suite.diagnose.data.view import FlightRows
from suite.diagnose.evidence.view_means import accelerations_on
from suite.diagnose.identify.grid import STEP_S, FlightGrid

DRIVES = {
    "rotors": ("rotor_speed",),
    "pwm": ("pwm",),
    "torques": ("thrust_cmd", "torque_cmd_b"),
    "rates": ("thrust_cmd", "rate_cmd_b"),
    "thrust": ("thrust_cmd",),
}
"""Signals that each drive needs: the first determines the thrust, the last the torque. The first
drive whose signals all flights have is used."""
KNOWN_MOTORS = ("rotors", "pwm")
"""Drives that determine each rotor's thrust; the others give commands to a controller."""
LEAST_LAG_S = 1e-4
"""A shorter lag (time constant) of the rotors counts as none [s]."""
LEAST_VOLTS = 0.1
"""Lower measured voltages are raised to this, so that a power of them is finite [V]."""
Accelerations = Callable[[FlightGrid, FlightRows], tuple[np.ndarray, np.ndarray]]
"""Function that returns dv/dt in world axes and dw/dt in body axes on each row, (G, 3) each."""


def common_drive(flights: Sequence[FlightGrid]) -> str:
    """Return the name of the drive that all `flights` have.

    Raises:
        ValueError: if there is none.
    """
    for name, signals in DRIVES.items():
        if all(flight.has(*signals) for flight in flights):
            return name
    raise ValueError(
        "the flights share no drive: every one needs rotor speeds, motor commands (pwm_1 to "
        "pwm_4), or a thrust command; identify flights of each kind separately"
    )


@dataclass(frozen=True)
class DrivenVehicle:
    """The start of a fit (the vehicle before it), and the drive of its flights.

    Methods take `numbers`, the values of fitted numbers by name. A missing number keeps its value
    in the start. `thrust` is the logarithm of the ratio of the thrust to the start's. With motor
    commands, this is the thrust at the usual command and voltage, and `curve` is the share of the
    quadratic term in it.
    """

    start: Vehicle
    drive: str
    """One of `DRIVES`."""
    usual_command: float = 1.0
    """Median motor command of the flights."""
    usual_volts: float = 1.0
    """Median voltage of the flights [V]."""

    @property
    def motors(self) -> MotorMap:
        """The start's motors; a placeholder for drives other than motor commands."""
        return self.start.motors or MotorMap((0.0, 1.0), 1.0, 0.0)

    @property
    def usual_thrust(self) -> tuple[float, float]:
        """Linear and quadratic term of the start's thrust at the usual command and voltage [N]."""
        first, second = self.motors.thrust
        volts_ratio = self.usual_volts / self.motors.voltage
        applied = self.usual_command * volts_ratio**self.motors.voltage_exponent
        return first * applied, second * applied**2

    @property
    def curve(self) -> float:
        """Share of the quadratic term in the start's usual thrust."""
        return self.usual_thrust[1] / sum(self.usual_thrust)

    @property
    def drag(self) -> tuple[float, ...]:
        """The start's linear drag along body axes [1/s]."""
        effect = self.start.effects.get("linear_drag")
        return (0.0, 0.0, 0.0) if effect is None else effect.coefficient

    def vehicle(self, numbers: Mapping[str, float]) -> Vehicle:
        """Return the vehicle with these `numbers`, and the effects that only depend on the state.

        Only measured rotor speeds identify the thrust coefficient. `yaw` is the logarithm of yaw
        torque over inertia about z, relative to the start. `inertia_x` and `inertia_y` are
        logarithms of ratios to the start, and `inertia_z` is relative to the mean of these two.
        """
        log_thrust = numbers.get("thrust", 0.0)
        x, y, z = (numbers.get(f"inertia_{axis}", 0.0) for axis in "xyz")
        log_inertia = np.array([x, y, 0.5 * (x + y) + z])
        start, rotors, scale = self.start, self.start.rotors, float(np.exp(log_thrust))
        effects = {n: v for n, v in start.effects.items() if EFFECTS[n].by_state}
        drag = (float(numbers.get(f"drag_{a}", d)) for a, d in zip("xyz", self.drag, strict=True))
        effects["linear_drag"] = EFFECTS["linear_drag"].values(tuple(drag))
        if self.drive not in KNOWN_MOTORS:
            effects["thrust_scale"] = EFFECTS["thrust_scale"].values(scale)
        log_twist = numbers.get("yaw", 0.0) + log_inertia[2]
        if self.drive == "rotors":
            rotors = replace(rotors, thrust_coefficient=rotors.thrust_coefficient * scale)
            log_twist += log_thrust
        twist = rotors.torque_coefficient * float(np.exp(log_twist))
        return replace(
            start,
            rotors=replace(rotors, torque_coefficient=twist),
            motors=self.motor_map(numbers) if self.drive == "pwm" else start.motors,
            inertia=_triple(np.asarray(start.inertia) * np.exp(log_inertia)),
            effects=effects,
        )

    def motor_map(self, numbers: Mapping[str, float]) -> MotorMap:
        """Return the table `[motors]` of a vehicle file with these `numbers`."""
        curve = numbers.get("curve", self.curve)
        battery = numbers.get("battery", self.motors.voltage_exponent)
        thrust = sum(self.usual_thrust) * float(np.exp(numbers.get("thrust", 0.0)))
        per_applied = (self.motors.voltage / self.usual_volts) ** battery / self.usual_command
        first, second = thrust * (1.0 - curve) * per_applied, thrust * curve * per_applied**2
        return MotorMap((float(first), float(second)), self.motors.voltage, float(battery))

    def accelerations(self, numbers: Mapping[str, float]) -> Accelerations:
        """Return the equations of the vehicle with these `numbers`; an unknown rotor speed is 0."""
        vehicle = self.vehicle(numbers)
        plant = make_plant(vehicle, LONGEST_S)

        def accelerations_of(flight: FlightGrid, rows: FlightRows) -> tuple[np.ndarray, np.ndarray]:
            speed = self._rotor_speed(flight, vehicle, numbers)
            rows = rows._replace(rotor_speed=np.nan_to_num(speed))
            acc_w, turn_b = accelerations_on(plant, rows, flight.has("voltage"))
            if self.drive == "torques":
                commanded = after_delay_and_lag(flight.signals["torque_cmd_b"], numbers)
                torque_b = np.nan_to_num(commanded)
                wrench = Wrench(np.zeros_like(torque_b), torque_b)
                _, turn_b = accelerations(plant, rows.motion, wrench)
            return acc_w, turn_b

        return accelerations_of

    def _rotor_speed(
        self, flight: FlightGrid, vehicle: Vehicle, numbers: Mapping[str, float]
    ) -> np.ndarray:
        """Return the rotor speeds (G, 4) of a flight [rad/s]: measured, or from their commands."""
        signals = flight.signals
        if self.drive == "rotors":
            return signals["rotor_speed"]
        if self.drive == "pwm":
            volts = np.full(len(flight.time_s), self.usual_volts)
            if flight.has("voltage"):
                volts = np.maximum(signals["voltage"], LEAST_VOLTS)
            commanded = motor_speed(vehicle, signals["pwm"], volts)
        else:
            thrust = 0.25 * vehicle.mass * np.maximum(signals["thrust_cmd"], 0.0)
            speed = np.sqrt(thrust / vehicle.rotors.thrust_coefficient)
            commanded = speed[:, None] * np.ones(4)  # a thrust command is equal for all rotors
        return after_delay_and_lag(commanded, numbers)


def driven_vehicle(
    flights: Sequence[FlightGrid], vehicle: Vehicle, drive: str, keep_motors: bool = False
) -> DrivenVehicle:
    """Return `vehicle` under `drive`, with the usual command and voltage of `flights`.

    With motor commands it has a table `[motors]` from motor command to thrust; a new one gives full
    speed at full command. Without a voltage its exponent is 0; the nominal voltage then means
    nothing, so it becomes the flights' median, but not in a table of the file with `keep_motors`.
    """
    if drive != "pwm":
        return DrivenVehicle(vehicle, drive)
    commands = [
        f.signals["pwm"][slice(None) if f.on_ground is None else ~f.on_ground] for f in flights
    ]
    command = float(np.nanmedian(np.concatenate(commands)))
    volts = [f.signals["voltage"] for f in flights if f.has("voltage")]
    exponent = 1.0 if volts else 0.0
    motors = vehicle.motors or MotorMap((0.0, vehicle.rotors.thrust_max), 1.0, exponent)
    usual_volts = float(np.nanmedian(np.concatenate(volts))) if volts else motors.voltage
    if vehicle.motors is None or not (keep_motors or motors.voltage_exponent):
        motors = replace(motors, voltage=usual_volts)
    return DrivenVehicle(replace(vehicle, motors=motors), drive, command, usual_volts)


def possible_inertia(inertia: ArrayLike) -> np.ndarray:
    """Return the inertia (3,) in which none is more than the sum of the others, as in any body."""
    return np.minimum(inertia, np.sum(inertia) - np.asarray(inertia))


def after_delay_and_lag(commands: np.ndarray, numbers: Mapping[str, float]) -> np.ndarray:
    """Return `commands` (G, C) as the rotors follow them: delayed, then with a first-order lag.

    `numbers["lag"]` is its time constant, and `numbers["late"]` the sum with the delay [s].
    """
    lag_s = numbers["lag"]
    return lagged(delayed(commands, numbers["late"] - lag_s), lag_s)


def delayed(values: np.ndarray, delay_s: float) -> np.ndarray:
    """Return `values` (G, C) as they were `delay_s` ago; before the first row, its value is used.

    A value is a mean over one step of the grid, so its time is the middle of the step.
    """
    rows = np.arange(len(values))
    place = rows - delay_s / STEP_S - 0.5
    return np.stack([np.interp(place, rows, column) for column in values.T], axis=1)


def lagged(values: np.ndarray, lag_s: float) -> np.ndarray:
    """Return `values` (G, C), linear between grid points, after a first-order lag."""
    if lag_s <= LEAST_LAG_S:
        return values
    complete = filled(values)
    # The lag's input over each step is the mean of the step's two ends.
    step_mean = 0.5 * (np.concatenate([complete[:1], complete[:-1]]) + complete)
    return np.where(np.isfinite(values), follow_lag(step_mean, STEP_S, lag_s), np.nan)


def filled(values: np.ndarray) -> np.ndarray:
    """Return `values` (G, C) in which each incomplete row repeats the last complete one."""
    rows = np.arange(len(values))
    return np.nan_to_num(hold(rows, rows, values))


def with_merged_effects(vehicle: Vehicle, known_motors: bool) -> Vehicle:
    """Return `vehicle` with its effects that scale a fitted number merged into that number.

    Otherwise they would scale the fitted number once more. With `known_motors`, `thrust_scale` is
    one of them. The same rotor speeds turn and lift the vehicle as before, and the nominal rate
    loop responds as before. The gain of a firmware's loop is not fitted, so its effect stays.

    Raises:
        ValueError: if a merged number is not allowed in a vehicle file, such as the thrust of
            rotors that are too weak to hover.
    """
    controller = vehicle.controller
    names = [*(["rate_gain"] if controller.kind == NOMINAL else []), "motor_lag", "inertia_scale"]
    names += ["thrust_scale"] if known_motors else []
    merged = {name: values for name, values in vehicle.effects.items() if name in names}
    if not merged:
        return vehicle
    rotors, motors = vehicle.rotors, vehicle.motors
    scaled = make_plant(vehicle, 1.0 / controller.frequency, merged).constants
    thrust_coefficient = float(scaled.thrust_coefficient[0])
    thrust_ratio = thrust_coefficient / rotors.thrust_coefficient
    if motors is not None:
        first, second = np.asarray(motors.thrust) * thrust_ratio
        motors = replace(motors, thrust=(float(first), float(second)))
    if controller.kind == NOMINAL:
        # The loop multiplies by the file's inertia, which was another than the body's.
        torque_ratio = torque_ratios(thrust_ratio) * vehicle.inertia / scaled.inertia
        controller = replace(controller, rate_gain=_triple(scaled.rate_gain * torque_ratio))
    lag_s = float(scaled.time_constant)
    result = replace(
        vehicle,
        rotors=replace(rotors, thrust_coefficient=thrust_coefficient, time_constant=lag_s),
        motors=motors,
        controller=controller,
        effects=MappingProxyType({n: v for n, v in vehicle.effects.items() if n not in merged}),
    )
    try:
        check_vehicle(result)
    except ValueError as error:
        raise ValueError(f"{vehicle.name} with its {', '.join(merged)}: {error}") from error
    return replace(result, inertia=_triple(possible_inertia(scaled.inertia)))


def torque_ratios(thrust_scale: float) -> np.ndarray:
    """Return the ratios (3,) of true to commanded torque with this scale of all thrusts.

    The torque about z does not come from the thrusts.
    """
    return np.array([thrust_scale, thrust_scale, 1.0])


def unmodelled_effects(vehicle: Vehicle) -> list[str]:
    """Return the vehicle's effects that the fits of force and torque do not model, by name."""
    return [
        name
        for name in vehicle.effects
        if not EFFECTS[name].by_state or EFFECTS[name].late is not None
    ]


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values
    return float(x), float(y), float(z)

"""Simulated flights of vehicles whose numbers are drawn and known, to judge the identification by.

A fleet is one vehicle on four flights, flown in MuJoCo under its nominal loop and logged with noise
that is white from row to row, and with a state estimator's slow errors (first-order, 0.1 to 1 s).
What the motors were told is worked out backwards from how their rotors turned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from eval.flights.follow import Recording
from eval.flights.simulate import Sensors, fly, log_of
from eval.flights.trajectory import Trajectory
from eval.logs.flight_log import FlightLog
from eval.quadrotor.mixer import mixer_matrix
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import MotorMap, Vehicle, command_of_thrust
from tracks.geometry.rotation import exp_rot, rot_to_quat

SENSORS = Sensors(
    "tracked", 250.0, pos=0.002, attitude=0.004, gyro=0.05, vel=0.03, rotor=5.0, voltage=0.02
)
DRAG, DELAY, FLAPPING = "linear_drag", "command_delay", "blade_flapping"


@dataclass(frozen=True)
class Slow:
    """A state estimator's errors: standard deviation, and how long they last [s]."""

    pos: tuple[float, float] = (0.004, 0.5)
    """Each axis [m]."""
    vel: tuple[float, float] = (0.03, 0.3)
    """Each axis [m/s]."""
    attitude: tuple[float, float] = (0.006, 1.0)
    """About each body axis [rad]."""
    gyro: tuple[float, float] = (0.02, 0.1)
    """Each axis [rad/s]."""


@dataclass(frozen=True)
class Fleet:
    """A vehicle with what flew it, and how its logs are written."""

    truth: Vehicle
    """Flown; its `[motors]`, drag, flapping and delay are those to be found."""
    ways: tuple[Trajectory, ...]
    """One a flight."""
    scale: float = 1.0
    """What is flown over the thrust command that is logged."""


def start() -> Vehicle:
    """Return what every fleet is identified from: right mass and arms, other numbers all off."""
    vehicle = load_vehicle("reference")
    motors = MotorMap(thrust=(1.6, 3.0), voltage=16.0, voltage_exponent=1.0)
    return replace(vehicle, motors=motors, effects=MappingProxyType({}))


def drawn(rng: np.random.Generator, duration_s: float = 8.0) -> Fleet:
    """Return a fleet of drawn numbers on drawn flights: an eight, a circle, climbs, a chirp."""

    def factor(span: float, count: int) -> np.ndarray:
        return np.exp(rng.uniform(-span, span, count))

    nominal = start()
    inertia = np.asarray(nominal.inertia) * factor(0.3, 3)
    inertia = np.minimum(inertia, 0.98 * (inertia.sum() - inertia))
    k_t, k_q = factor(0.2, 1)[0], factor(0.3, 1)[0]
    rotors = replace(
        nominal.rotors,
        thrust_coefficient=float(nominal.rotors.thrust_coefficient * k_t),
        torque_coefficient=float(nominal.rotors.torque_coefficient * k_q),
        time_constant=float(rng.uniform(0.015, 0.05)),
    )
    gains = (*rng.uniform(12.0, 26.0, 2).tolist(), float(rng.uniform(5.0, 10.0)))
    motors = MotorMap(
        thrust=(float(rng.uniform(0.5, 2.5)), float(rng.uniform(2.5, 5.0))),
        voltage=16.0,
        voltage_exponent=float(rng.uniform(0.5, 1.6)),
    )
    step_s = 1.0 / nominal.controller.frequency
    effects = {
        DRAG: EFFECTS[DRAG].values(tuple(rng.uniform(0.1, 0.6, 3).tolist())),
        DELAY: EFFECTS[DELAY].values(float(step_s * rng.integers(1, 11))),
    }
    truth = replace(
        nominal,
        inertia=tuple(inertia.tolist()),
        rotors=rotors,
        controller=replace(nominal.controller, rate_gain=gains),
        motors=motors,
        effects=MappingProxyType(effects),
    )
    speeds = rng.uniform(2.5, 5.0, 4) * [1.0, 1.0, 0.8, 0.2]
    kinds = {"figure_eight": "sweep", "circle": "wobble", "climb": "wobble", "chirp": "wobble"}
    ways = tuple(
        Trajectory(kind, duration_s, speed, turn=turn, direction=float(rng.uniform(0.0, 2 * np.pi)))
        for (kind, turn), speed in zip(kinds.items(), speeds.tolist(), strict=True)
    )
    scale = float(factor(0.15, 1)[0])
    flapping = EFFECTS[FLAPPING].values(float(rng.uniform(1e-7, 6e-7)))
    blown = MappingProxyType({**effects, FLAPPING: flapping})
    return Fleet(replace(truth, effects=blown), ways, scale)


def recordings_of(fleet: Fleet, rate_hz: float = SENSORS.rate_hz) -> list[Recording]:
    """Return what happened on the flights at every step; the pilot knows the vehicle's loop."""
    nominal = replace(fleet.truth, effects=MappingProxyType({}))
    return fly(nominal, fleet.truth, fleet.ways, rate_hz)


def logs_of(
    fleet: Fleet, recordings: Sequence[Recording], drive: str, rng: np.random.Generator,
    slow: Slow | None = None, sensors: Sensors = SENSORS,
) -> list[FlightLog]:  # fmt: skip
    """Return logs with what `drive` (one of `drive.DRIVES`) needs, and no other drive's.

    Slow errors come besides the white noise of `sensors`.
    """
    found = []
    for index, recording in enumerate(recordings):
        log = log_of(recording, fleet.truth, sensors, rng, f"flight_{index}")
        log = replace(log, extra={}, about={}, thrust_cmd=None, rate_cmd_b=None)
        if slow is not None:
            log = _erring(log, slow, rng)
        rows = slice(None, None, recording.period)
        asked = _row_means(_asked_speed(fleet.truth, recording), recording.period)
        thrust = fleet.truth.rotors.thrust_coefficient * asked**2
        if drive != "rotors":
            log = replace(log, rotor_speed=None)
        changed: dict[str, Any] = {}
        if drive == "rotors":
            changed["rotor_speed_cmd"] = asked
        elif drive == "pwm":
            changed["pwm"] = _row_means(_commands(fleet.truth, recording), recording.period)
        elif drive == "torques":
            changed["thrust_cmd"] = thrust.sum(axis=1) / fleet.truth.mass / fleet.scale
            changed["torque_cmd_b"] = torque_of(fleet.truth, thrust)
        else:
            changed["thrust_cmd"] = recording.command.thrust[rows] / fleet.scale
            if drive == "rates":
                changed["rate_cmd_b"] = recording.command.rate_b[rows].copy()
        found.append(replace(log, **changed))
    return found


def torque_of(vehicle: Vehicle, thrust: np.ndarray) -> np.ndarray:
    """Return the torques (T, 3) [N m] of rotor thrusts (T, 4) on the vehicle's arms."""
    rotors = vehicle.rotors
    ratio = rotors.torque_coefficient / rotors.thrust_coefficient
    mixer = mixer_matrix(np.array(rotors.position), np.array(rotors.spin), ratio)
    return thrust @ mixer[1:].T


def truths(fleet: Fleet, drive: str, told: str = "xyz") -> Mapping[str, tuple[float, ...]]:
    """Return the true values of all that may be told, by their key in a vehicle file.

    The torque coefficient is that which goes with what else is in the file then: the inertia about
    z, which follows those about the axes `told` where it was not, and the thrust coefficient,
    which only rotor speeds tell. Flapping goes with the rotors' speeds, so with that as well.
    """
    true, begun = fleet.truth, start()
    assert true.motors is not None
    ratio = np.asarray(true.inertia) / begun.inertia
    twist = true.rotors.torque_coefficient
    if "z" not in told:
        twist *= float(np.sqrt(np.prod([ratio["xy".index(axis)] for axis in told])) / ratio[2])
    flapping = true.effects[FLAPPING].coefficient
    if drive != "rotors":
        ratio_t = begun.rotors.thrust_coefficient / true.rotors.thrust_coefficient
        twist, flapping = twist * ratio_t, flapping * ratio_t**0.5
    return {
        "motors.thrust": true.motors.thrust,
        "motors.voltage_exponent": (true.motors.voltage_exponent,),
        "effects.linear_drag.coefficient": tuple(true.effects[DRAG].coefficient),
        "effects.thrust_scale.scale": (fleet.scale,),
        "effects.blade_flapping.coefficient": (flapping,),
        "effects.command_delay.delay": (true.effects[DELAY].delay,),
        "inertia": true.inertia,
        "rotors.thrust_coefficient": (true.rotors.thrust_coefficient,),
        "rotors.torque_coefficient": (twist,),
        "rotors.time_constant": (true.rotors.time_constant,),
        "controller.rate_gain": true.controller.rate_gain,
    }


def _asked_speed(truth: Vehicle, recording: Recording) -> np.ndarray:
    """Return the rotor speeds (K, 4) that were commanded at every step: lag and delay undone."""
    keep = np.exp(-recording.dt / truth.rotors.time_constant)
    speed = recording.rotor_speed
    asked = (speed[1:] - keep * speed[:-1]) / (1.0 - keep)
    asked = np.concatenate([asked, asked[-1:]])
    late = round(truth.effects[DELAY].delay / recording.dt)
    return np.concatenate([asked[late:], np.repeat(asked[-1:], late, axis=0)])


def _commands(truth: Vehicle, recording: Recording) -> np.ndarray:
    """Return the motor commands (K, 4) behind the speeds, at the voltage at which they act."""
    motors = truth.motors
    assert motors is not None
    thrust = truth.rotors.thrust_coefficient * _asked_speed(truth, recording) ** 2
    applied = command_of_thrust(motors.thrust, thrust)
    late = round(truth.effects[DELAY].delay / recording.dt)
    volts = recording.voltage
    volts = np.concatenate([volts[late:], np.repeat(volts[-1:], late)])
    return applied / ((volts / motors.voltage) ** motors.voltage_exponent)[:, None]


def _row_means(values: np.ndarray, period: int) -> np.ndarray:
    """Return the means (T, 4) of `values` (K, 4) until the next row: what a row's command is."""
    padded = np.concatenate([values, np.repeat(values[-1:], -len(values) % period, axis=0)])
    return padded.reshape(-1, period, values.shape[1]).mean(axis=1)


def _erring(log: FlightLog, slow: Slow, rng: np.random.Generator) -> FlightLog:
    rot_w = log.rot_w @ np.asarray(exp_rot(_wander(log, slow.attitude, rng)))
    return replace(
        log,
        pos_w=log.pos_w + _wander(log, slow.pos, rng),
        vel_w=log.vel_w + _wander(log, slow.vel, rng),
        quat_wxyz=np.asarray(rot_to_quat(rot_w)),
        rate_b=log.rate_b + _wander(log, slow.gyro, rng),
    )


def _wander(log: FlightLog, size: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """Return a stationary first-order process (T, 3)."""
    from scipy.signal import lfilter

    sigma, lasts_s = size
    keep = float(np.exp(-np.median(np.diff(log.time_s)) / lasts_s))
    push = sigma * np.sqrt(1.0 - keep**2) * rng.standard_normal((len(log.time_s), 3))
    push[0] = sigma * rng.standard_normal(3)
    return np.asarray(lfilter([1.0], [1.0, -keep], push, axis=0))

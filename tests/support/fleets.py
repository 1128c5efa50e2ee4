"""Simulated flights of vehicles whose numbers are known, to judge the identification by.

A fleet is one vehicle on its flights, flown in MuJoCo under its nominal loop and logged with noise
that is white from row to row. The commands of the motors are computed backwards from the speeds of
their rotors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from eval.flights.follow import Recording
from eval.flights.simulate import Sensors, fly, log_of
from eval.flights.trajectory import Trajectory
from eval.logs.flight_log import FlightLog
from eval.quadrotor.mixer import mixer_matrix
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import MotorMap, Vehicle, command_of_thrust

SENSORS = Sensors(
    "tracked", 250.0, pos=0.002, attitude=0.004, gyro=0.05, vel=0.03, rotor=5.0, voltage=0.02
)
DELAY = "command_delay"


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


def recordings_of(fleet: Fleet, rate_hz: float = SENSORS.rate_hz) -> list[Recording]:
    """Return what happened on the flights at every step; the pilot knows the vehicle's loop."""
    nominal = replace(fleet.truth, effects=MappingProxyType({}))
    return fly(nominal, fleet.truth, fleet.ways, rate_hz)


def logs_of(
    fleet: Fleet, recordings: Sequence[Recording], drive: str, rng: np.random.Generator,
    sensors: Sensors = SENSORS, spoil: Callable[[FlightLog], FlightLog] = lambda log: log,
) -> list[FlightLog]:  # fmt: skip
    """Return logs with what `drive` (one of `drive.DRIVES`) needs, and no other drive's.

    `spoil` may add errors to those of `sensors`.
    """
    found = []
    for index, recording in enumerate(recordings):
        log = log_of(recording, fleet.truth, sensors, rng, f"flight_{index}")
        log = spoil(replace(log, extra={}, about={}, thrust_cmd=None, rate_cmd_b=None))
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

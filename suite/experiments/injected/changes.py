"""Changes of the signals of a flight, or of its vehicle file, that no reading can describe."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.frames import conjugate, multiply, rotate
from eval.vehicles.vehicle import MotorMap, Vehicle

Signals = dict[str, np.ndarray]
"""Signal -> (T, C) values at T times in C components, in SI units and the suite's frames; `time` is
(T,) [s]."""
COMMANDS = ("cmd_rate", "throttle", "cmd_thrust")
"""Signals that are commands of the policy."""
LINEAR, SQUARE = 0.62, 1.78
"""Coefficients of the firmware's curve: body rate = LINEAR stick + SQUARE stick^2, where rate and
stick are relative to typical large values (the 98 % quantile of the rate)."""


def remove_gravity(signals: Signals, _: Vehicle) -> Signals:
    """Log the acceleration without gravity; an accelerometer at rest shows it as 9.81 upwards."""
    gravity_b = rotate(conjugate(signals["quat"]), np.array([0.0, 0.0, GRAVITY]))
    return {**signals, "acc": signals["acc"] - gravity_b}


def add_throttle_bias(signals: Signals, _: Vehicle) -> Signals:
    """Add a vertical accelerometer error that grows with the square of the throttle."""
    bias = -0.46 * GRAVITY * signals["throttle"] ** 2
    return {**signals, "acc": signals["acc"] + bias * [0.0, 0.0, 1.0]}


def linear_stick_map(signals: Signals, _: Vehicle) -> Signals:
    """Log commands of a linear stick map; the firmware's curve gives 0.62 to 2.4 times as much."""
    command = signals["cmd_rate"]
    largest = np.maximum(np.quantile(np.abs(command), 0.98, axis=0), 1e-6)
    share = np.clip(np.abs(command) / largest, 0.0, 1.5)
    # The curve is share = LINEAR stick + SQUARE stick^2, solved for the stick.
    stick = (-LINEAR + np.sqrt(LINEAR**2 + 4.0 * SQUARE * share)) / (2.0 * SQUARE)
    return {**signals, "cmd_rate": np.sign(command) * stick * largest}


def hold_commands(signals: Signals, _: Vehicle) -> Signals:
    """Update commands at two thirds of the policy's rate: 20 instead of 30 Hz."""
    step = float(np.median(np.diff(signals["time"])))
    # Time of the last update before each row, and the row at that time.
    update_s = np.floor(signals["time"] * 20.0 + 1e-6) / 20.0
    index = np.clip(np.round((update_s - signals["time"][0]) / step).astype(int), 0, None)
    return {**signals, **{n: signals[n][index] for n in COMMANDS if n in signals}}


def hold_rotor_speeds(signals: Signals, _: Vehicle) -> Signals:
    """Log rotor speeds of a telemetry with ten samples a second, in every row."""
    time_s = signals["time"]
    sample_s = np.arange(time_s[0], time_s[-1], 0.1)
    row = np.searchsorted(time_s, sample_s)[np.searchsorted(sample_s, time_s, side="right") - 1]
    return {**signals, "motor": signals["motor"][row]}


def drop_rotor_speeds(signals: Signals, _: Vehicle) -> Signals:
    """Log 0 for 3 % of the rotor speeds."""
    lost = np.random.default_rng(0).random(signals["motor"].shape) < 0.03
    return {**signals, "motor": np.where(lost, 0.0, signals["motor"])}


def turn_attitude(signals: Signals, _: Vehicle) -> Signals:
    """Log an attitude whose heading is off by 15 deg."""
    half = np.radians(7.5)
    turn = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
    quat = signals["quat"]
    return {**signals, "quat": multiply(np.broadcast_to(turn, quat.shape), quat)}


def shift(signals: Signals, _: Vehicle, late_s: float, names: tuple[str, ...]) -> Signals:
    """Log the signals `names` late by `late_s` [s], early if it is negative."""
    count = round(late_s / float(np.median(np.diff(signals["time"]))))
    moved = {n: np.roll(signals[n], count, axis=0) for n in names if n in signals}
    kept = slice(max(count, 0), min(count, 0) or None)
    return {name: value[kept] for name, value in {**signals, **moved}.items()}


def speed_up_pose_clock(signals: Signals, _: Vehicle) -> Signals:
    """Stamp position, velocity and attitude by a clock that runs 0.5 % fast."""
    time_s = signals["time"]
    return with_pose_at(signals, time_s - 0.005 * (time_s - time_s.mean()))


def set_pose_clock(signals: Signals, _: Vehicle) -> Signals:
    """Stamp the second half of position, velocity and attitude 60 ms late."""
    time_s = signals["time"]
    return with_pose_at(signals, time_s - 0.06 * (time_s > time_s.mean()))


def with_pose_at(signals: Signals, true_s: np.ndarray) -> Signals:
    """Return the signals with the pose of the times `true_s` (T,) in place of those logged [s]."""
    time_s = signals["time"]
    stretched = {
        n: np.stack([np.interp(true_s, time_s, c) for c in signals[n].T], axis=1)
        for n in ("pos", "vel", "quat")
        if n in signals
    }
    stretched["quat"] /= np.linalg.norm(stretched["quat"], axis=1, keepdims=True)
    return {**signals, **stretched}


def jitter_stamps(signals: Signals, _: Vehicle) -> Signals:
    """Stamp each row by the arrival of its message, late by up to 80 % of the time to the next."""
    time_s, rng = signals["time"], np.random.default_rng(0)
    step_s = np.diff(time_s, append=2.0 * time_s[-1] - time_s[-2])
    return {**signals, "time": time_s + rng.uniform(0.0, 0.8, len(time_s)) * step_s}


def drop_barometer(signals: Signals, _: Vehicle) -> Signals:
    """Add two seconds on the ground; then the barometer falls by 1.6 m as the motors start."""
    step = float(np.median(np.diff(signals["time"])))
    count = round(2.0 / step)
    ground = {n: np.repeat(v[:1], count, axis=0) for n, v in signals.items() if n != "time"}
    for name in ("motor", "vel", "rate", *COMMANDS):
        if name in ground:
            ground[name] = 0.0 * ground[name]
    joined = {n: np.concatenate([v, signals[n]]) for n, v in ground.items()}
    joined["time"] = signals["time"][0] + step * np.arange(count + len(signals["time"]))
    joined["baro"][count:] -= 1.6
    return joined


def unlinearised(signals: Signals, _: Vehicle) -> Signals:
    """The firmware does not linearise the throttle: thrust grows with its square."""
    share = np.sqrt(np.clip(signals["throttle"], 0.0, None))
    full = np.median(signals["cmd_thrust"]) / np.median(signals["throttle"])
    return {**signals, "throttle": share, "cmd_thrust": full * share}


def drained(signals: Signals, _: Vehicle) -> Signals:
    """A flight to an empty battery, which the firmware compensates."""
    time_s = signals["time"]
    left = np.interp(time_s, (time_s[0], time_s[-1]), (1.05, 0.8))
    return {**signals, "voltage": signals["voltage"] * left[:, None]}


def map_of(vehicle: Vehicle) -> MotorMap:
    """Return the motor map, which the vehicle must have."""
    assert vehicle.motors is not None
    return vehicle.motors


def with_motors(vehicle: Vehicle, **changes: Any) -> Vehicle:
    """Return the vehicle with `changes` of its motor map."""
    return replace(vehicle, motors=replace(map_of(vehicle), **changes))


def other_curve(vehicle: Vehicle) -> Vehicle:
    """A linear curve in place of a quadratic one or the reverse, equal at half command."""
    linear, square = map_of(vehicle).thrust
    half = 0.5 * linear + 0.25 * square
    return with_motors(
        vehicle, thrust=(0.0, 4.0 * half) if linear > 0.5 * square else (2.0 * half, 0.0)
    )


def with_rotors(vehicle: Vehicle, **changes: Any) -> Vehicle:
    """Return `vehicle` with other values for fields of its rotors."""
    return replace(vehicle, rotors=replace(vehicle.rotors, **changes))


def arms_in_mm(vehicle: Vehicle) -> Vehicle:
    """Return `vehicle` with rotor positions in millimetres, which a reader takes for metres."""
    hubs = tuple(tuple(1000.0 * c for c in hub) for hub in vehicle.rotors.position)
    return with_rotors(vehicle, position=hubs)

"""Flights without a fault, into which faults are injected: noisy simulated ones, and real logs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from eval.effects import EFFECTS
from eval.effects.interface import GRAVITY
from eval.importers.frames import conjugate, rotate
from eval.logs.columns import GROUPS
from eval.logs.flight_log import FlightLog, log_from_columns
from eval.logs.velocity import velocity_from_position
from eval.vehicles.vehicle import MotorMap, Vehicle

TRUE_EFFECTS = {"com_offset": EFFECTS["com_offset"].values((0.006, -0.003, 0.0))}
"""Effects of the vehicle that flies (an offset of the centre of mass [m]); the nominal vehicle,
with which the logs are compared, lacks them."""
NOISE = {"pos": 0.002, "vel": 0.02, "quat": 0.001, "rate": 0.03, "acc": 0.3, "motor": 3.0,
         "voltage": 0.05, "baro": 0.05}  # fmt: skip
"""Signal -> standard deviation of its white noise, in SI units."""
REAL_MOTORS = {"nanobench": MotorMap((0.0644, 0.0199), 3.7, 0.61)}
"""Real logs whose motors are not those of the shipped file -> their map, by `suite identify`
(docs/results/real.md)."""
LOGS = ("nanobench/*.csv", "crazyswarm2/log*", "crazypad/*/*log*")
"""Patterns of the real logs' files."""


def with_linear_motors(vehicle: Vehicle) -> Vehicle:
    """Return the vehicle with the `[motors]` that `flight_signals` has: linear, no battery."""
    return replace(vehicle, motors=MotorMap((vehicle.rotors.thrust_max, 0.0), 16.0, 0.0))


def flight_signals(
    log: FlightLog, vehicle: Vehicle, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Return a simulated flight as noisy signals, with a battery voltage and a barometer.

    The full thrust of the vehicle gives the throttle.

    Returns:
        Signal -> (T, C) values at T times in C components, in SI units and the suite's frames.
        `time` is (T,) [s].
    """
    assert log.thrust_cmd is not None and log.rate_cmd_b is not None and log.rotor_speed is not None
    acc_w = velocity_from_position(log.time_s, log.vel_w)  # the derivative of any signal
    signals = {
        "time": log.time_s,
        "pos": log.pos_w,
        "quat": log.quat_wxyz,
        "vel": log.vel_w,
        "rate": log.rate_b,
        "acc": rotate(conjugate(log.quat_wxyz), acc_w + [0.0, 0.0, GRAVITY]),
        "cmd_thrust": log.thrust_cmd[:, None],
        "cmd_rate": log.rate_cmd_b,
        "motor": log.rotor_speed,
        "pwm": (log.rotor_speed / vehicle.rotors.speed_max) ** 2,
        "throttle": log.thrust_cmd[:, None] / vehicle.full_thrust,
        "voltage": (16.0 - 0.05 * log.time_s)[:, None],
        "baro": log.pos_w[:, 2:],
    }
    for name, sigma in NOISE.items():
        signals[name] = signals[name] + sigma * rng.normal(size=signals[name].shape)
    signals["quat"] = signals["quat"] / np.linalg.norm(signals["quat"], axis=1, keepdims=True)
    return signals


def as_log(signals: Mapping[str, np.ndarray], name: str) -> FlightLog:
    """Return signals as a flight log, with extra columns `throttle` and `baro`.

    The signals are as from `flight_signals`. A log without pose or rates becomes a partial log.

    Raises:
        FlightLogError: if the signals break a rule of flight logs.
    """
    columns = {"time": signals["time"]}
    for group, names in GROUPS.items():
        if group != "time" and group in signals:
            columns |= dict(zip(names, np.asarray(signals[group]).T, strict=True))
    columns |= {n: signals[n][:, 0] for n in ("throttle", "baro") if n in signals}
    missing = [group for group in ("pos", "quat", "rate") if group not in signals]
    return log_from_columns(columns, {"partial": missing} if missing else {}, name, limits=False)


def real_logs(folder: Path) -> list[Path]:
    """Return the real logs in `folder`, sorted; none if the folder is missing."""
    return [path for pattern in LOGS for path in sorted(folder.glob(pattern))]

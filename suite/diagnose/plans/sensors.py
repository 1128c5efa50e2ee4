"""What is logged of a flight, and with how much noise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from eval.effects.log_faults import apply_log_faults
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.plans.follow import Recording


@dataclass(frozen=True)
class Sensors:
    """Channels with the standard deviation of their white noise; 0 leaves a channel out."""

    name: str
    """For tables."""
    rate_hz: float
    """Of the log."""
    pos: float
    """Each axis [m]."""
    attitude: float
    """About each body axis [rad]."""
    gyro: float
    """Each axis [rad/s]."""
    vel: float = 0.0
    """Each axis [m/s]."""
    acc: float = 0.0
    """Each axis [m/s^2]."""
    rotor: float = 0.0
    """Each rotor [rad/s]."""
    voltage: float = 0.0
    """[V]."""
    lost: float = 0.0
    """Share of rows in which the pose is missing, in stretches of three rows."""


SENSORS: dict[str, Sensors] = {
    sensors.name: sensors
    for sensors in (
        Sensors("capture", 100.0, pos=0.001, attitude=0.0026, gyro=0.02, lost=0.005),
        Sensors("estimator", 100.0, pos=0.005, attitude=0.004, gyro=0.02, vel=0.03, acc=0.3),
        Sensors(
            "full",
            125.0,
            pos=0.002,
            attitude=0.003,
            gyro=0.02,
            vel=0.03,
            acc=0.3,
            rotor=5.0,
            voltage=0.02,
        ),
    )
}
"""Motion capture and a gyro; a state estimator's output; and a log of everything."""


def log_of(
    recording: Recording,
    truth: Vehicle,
    sensors: Sensors,
    rng: np.random.Generator | None,
    name: str = "flight",
) -> FlightLog:
    """Return the log of a flight: the truth's faults of the log first, then noise.

    Args:
        recording: at every physics step.
        truth: whose log faults are applied, at the physics rate.
        sensors: what is logged; its rate must be the recording's.
        rng: of the noise; None logs without noise and without holes (a noise-free twin).
        name: of the flight.
    """
    motion = recording.motion
    true = {
        "time_s": recording.time_s,
        "pos_w": motion.pos_w,
        "quat_wxyz": recording.quat_wxyz,
        "vel_w": motion.vel_w,
        "rate_b": motion.rate_b,
        "acc_b": recording.acc_b,
    }
    seen = apply_log_faults(truth.effects, true)
    rows = slice(None, None, recording.period)
    about: dict[str, Any] = {"source": "suite blind"}
    if recording.integrator is not None:
        about |= {"integrator": recording.integrator, "step_s": recording.dt}

    def measured(values: np.ndarray, sigma: float) -> np.ndarray:
        values = np.array(values[rows])
        return values if rng is None else values + sigma * rng.standard_normal(values.shape)

    pos_w, rate_b = measured(seen["pos_w"], sensors.pos), measured(seen["rate_b"], sensors.gyro)
    quat = np.array(seen["quat_wxyz"][rows])
    if rng is not None:
        quat = _turned(quat, sensors.attitude * rng.standard_normal((len(quat), 3)))
        lost = rng.random(len(quat)) < sensors.lost / 3.0
        lost[:2] = lost[-4:] = False
        for row in np.flatnonzero(lost):
            pos_w[row : row + 3] = np.nan
            quat[row : row + 3] = np.nan
    return FlightLog(
        name=name,
        time_s=recording.time_s[rows].copy(),
        pos_w=pos_w,
        quat_wxyz=quat,
        vel_w=measured(seen["vel_w"], sensors.vel),
        rate_b=rate_b,
        thrust_cmd=recording.command.thrust[rows].copy(),
        rate_cmd_b=recording.command.rate_b[rows].copy(),
        rotor_speed=measured(recording.rotor_speed, sensors.rotor) if sensors.rotor else None,
        acc_b=measured(seen["acc_b"], sensors.acc) if sensors.acc else None,
        voltage=measured(recording.voltage, sensors.voltage) if sensors.voltage else None,
        about=about,
        # Not written to a file, as if it had not been measured.
        velocity_derived=not sensors.vel,
    )


def _turned(quat: np.ndarray, angle_b: np.ndarray) -> np.ndarray:
    """Return quat (T, 4) turned by the small rotations angle_b (T, 3) about body axes [rad]."""
    size = np.linalg.norm(angle_b, axis=1, keepdims=True)
    # sinc(x / pi) is sin(x) / x.
    vector = 0.5 * angle_b * np.sinc(0.5 * size / np.pi)
    scalar = np.cos(0.5 * size)
    w, xyz = quat[:, :1], quat[:, 1:]
    return np.concatenate(
        [
            w * scalar - (xyz * vector).sum(1, keepdims=True),
            w * vector + scalar * xyz + np.cross(xyz, vector),
        ],
        axis=1,
    )

"""Sensor model `imu`: an inertial measurement unit with bias, noise, vibration and saturation.

It changes the samples of gyroscope and accelerometer that a state estimator uses. It does not
change the policy's observation directly.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from eval.sensors.interface import Array, Draws, Inertial, Moment, Needs, Parameter, Sensor, column

UNLIMITED = 1e6
"""Limit of a sensor that does not saturate."""


class Imu(NamedTuple):
    """Parameters of `imu`; units in `SENSOR`, letters as in its `equation`."""

    gyro_noise: Array
    """s_w: noise density of the gyroscope."""
    gyro_bias: Array
    """b_w: standard deviation of the gyroscope's bias at the start."""
    gyro_walk: Array
    """Random walk of the gyroscope's bias."""
    gyro_limit: Array
    """Largest measurable body rate."""
    acc_noise: Array
    """s_a: noise density of the accelerometer."""
    acc_bias: Array
    """b_a: standard deviation of the accelerometer's bias at the start."""
    acc_walk: Array
    """Random walk of the accelerometer's bias."""
    acc_limit: Array
    """Largest measurable specific force."""
    acc_per_thrust: Array
    """k: standard deviation over trials of an accelerometer error in proportion to the thrust."""
    vibration: Array
    """v: standard deviation of an accelerometer noise in proportion to the thrust."""


def start(values: Imu, moment: Moment) -> dict[str, Any]:
    """Return the trial's biases and accelerometer error per thrust, each (..., 3), by name."""
    draws = moment.draws.normal
    return {
        "gyro": column(values.gyro_bias) * draws[..., :3],
        "acc": column(values.acc_bias) * draws[..., 3:6],
        "per_thrust": column(values.acc_per_thrust) * draws[..., 6:],
    }


def measure(
    values: Imu, memory: dict[str, Any], truth: Inertial, draws: Draws, dt_s: Any
) -> tuple[Inertial, dict[str, Any]]:
    """Return the measurement of a true sample, and the biases after a step of their random walk."""
    normal = draws.normal
    xp = normal.__array_namespace__()
    root_dt = dt_s**0.5
    gyro_bias = memory["gyro"] + column(values.gyro_walk) * root_dt * normal[..., 6:9]
    acc_bias = memory["acc"] + column(values.acc_walk) * root_dt * normal[..., 9:12]
    thrust = column(abs(truth.acc_b[..., 2]))
    rate_b = truth.rate_b + gyro_bias + column(values.gyro_noise) / root_dt * normal[..., :3]
    acc_sd = column(values.acc_noise) / root_dt + column(values.vibration) * thrust
    acc_b = truth.acc_b + acc_bias + memory["per_thrust"] * thrust + acc_sd * normal[..., 3:6]
    limits = column(values.gyro_limit), column(values.acc_limit)
    rate_b, acc_b = (xp.clip(v, -m, m) for v, m in zip((rate_b, acc_b), limits, strict=True))
    return Inertial(rate_b, acc_b), memory | {"gyro": gyro_bias, "acc": acc_bias}


SENSOR = Sensor(
    name="imu",
    stage="imu",
    summary="Gyroscope and accelerometer: bias, noise, vibration with thrust, saturation",
    equation="w + b_w + s_w n / sqrt(dt); a + b_a + k |a_z| + (s_a / sqrt(dt) + v |a_z|) n; "
    "db = walk sqrt(dt) n; clipped to the limits",
    source="data sheets of BMI270, BMI088 and ICM-42688-P: 0.003 to 0.014 deg/s/sqrt(Hz), 65 to "
    "230 ug/sqrt(Hz), 2000 deg/s, 16 to 24 g; biases, walks and vibration are our estimate",
    values=Imu,
    parameters=(
        Parameter("gyro_noise", "rad/s/Hz^0.5", 0.0, 0.0, 1.0, (1e-4, 1e-3)),
        Parameter("gyro_bias", "rad/s", 0.0, 0.0, 2.0, (0.002, 0.02)),
        Parameter("gyro_walk", "rad/s^1.5", 0.0, 0.0, 1.0, (1e-5, 1e-3)),
        Parameter("gyro_limit", "rad/s", UNLIMITED, 0.1, UNLIMITED, (8.7, 34.9)),
        Parameter("acc_noise", "m/s^2/Hz^0.5", 0.0, 0.0, 10.0, (1e-3, 1e-2)),
        Parameter("acc_bias", "m/s^2", 0.0, 0.0, 20.0, (0.05, 0.3)),
        Parameter("acc_walk", "m/s^2.5", 0.0, 0.0, 10.0, (1e-4, 1e-2)),
        Parameter("acc_limit", "m/s^2", UNLIMITED, 1.0, UNLIMITED, (78.5, 235.0)),
        Parameter("acc_per_thrust", "1", 0.0, 0.0, 1.0, (0.005, 0.03)),
        Parameter("vibration", "1", 0.0, 0.0, 10.0, (0.02, 0.2)),
    ),
    grows=(
        *("gyro_noise", "gyro_bias", "gyro_walk", "acc_noise", "acc_bias", "acc_walk"),
        *("acc_per_thrust", "vibration"),
    ),
    trial=Needs(normal=9),
    observation=Needs(normal=12),
    start=start,
    measure=measure,
)

"""Sensor model `gate_filter`: a Kalman filter estimates the state from IMU and gate corners.

The policy gets the state that the filter (`eval/sensors/filter/`) estimates, not the true state.
The filter's map of the gates is exact. A gate's corner is detected if it is in the field of view
and in range; obstacles do not hide it.
"""

from __future__ import annotations

from typing import NamedTuple

from eval.sensors.interface import Array, Parameter, Sensor


class GateFilter(NamedTuple):
    """Parameters of `gate_filter`; units in `SENSOR` where a line has none."""

    pixel: Array
    """Noise of a corner in the image, standard deviation [pixels]."""
    width: Array
    """Pixels across the camera's field of view."""
    rate: Array
    """Frames per second [Hz]."""
    dropout: Array
    """Share of the frames without a detection."""
    dropout_length: Array
    """Mean duration of a dropout [s]."""
    delay: Array
    """Time from a frame to its use in the filter [s]."""
    range: Array
    """Corners further away are not detected [m]."""
    position: Array
    """Standard deviation of the position error at the start, for each axis."""
    velocity: Array
    """Standard deviation of the velocity error at the start, for each axis."""
    attitude: Array
    """Standard deviation of the attitude error at the start, for each axis."""
    acc_bias: Array
    """Standard deviation of the accelerometer's bias that the filter assumes, for each axis."""
    gyro_bias: Array
    """Standard deviation of the gyroscope's bias that the filter assumes, for each axis."""
    acc_noise: Array
    """Noise density of the accelerometer that the filter assumes."""
    gyro_noise: Array
    """Noise density of the gyroscope that the filter assumes."""
    acc_walk: Array
    """Random walk of the accelerometer's bias that the filter assumes."""
    gyro_walk: Array
    """Random walk of the gyroscope's bias that the filter assumes."""


SENSOR = Sensor(
    name="gate_filter",
    stage="state",
    summary="A Kalman filter estimates the state from the IMU and from delayed gate corners",
    equation="error-state Kalman filter (eval/sensors/filter/kalman.py); corners (u, v) + s n "
    "arrive `delay` late; a share `dropout` of the frames has none",
    source="Solà 2017 (filter); noise of a pixel: Foehn et al. 2022 (AlphaPilot, gate corners "
    "by a network); noise densities and walks: ten times a MEMS data sheet (ICM-20689), "
    "to allow for vibration",
    values=GateFilter,
    parameters=(
        Parameter("pixel", "1", 0.05, 0.05, 50.0, (0.5, 3.0)),
        Parameter("width", "1", 640.0, 16.0, 8192.0, (320.0, 1280.0)),
        Parameter("rate", "Hz", 30.0, 0.1, 500.0, (15.0, 60.0)),
        Parameter("dropout", "1", 0.0, 0.0, 0.95, (0.05, 0.5)),
        Parameter("dropout_length", "s", 0.0, 0.0, 60.0, (0.1, 0.5)),
        Parameter("delay", "s", 0.0, 0.0, 0.5, (0.02, 0.1)),
        Parameter("range", "m", 15.0, 0.5, 1000.0, (5.0, 20.0)),
        Parameter("position", "m", 0.001, 1e-4, 10.0, (0.02, 0.2)),
        Parameter("velocity", "m/s", 0.001, 1e-4, 10.0, (0.01, 0.1)),
        Parameter("attitude", "rad", 0.0005, 1e-5, 0.5, (0.005, 0.03)),
        Parameter("acc_bias", "m/s^2", 0.05, 1e-5, 5.0, (0.05, 0.3)),
        Parameter("gyro_bias", "rad/s", 0.005, 1e-6, 1.0, (0.002, 0.02)),
        Parameter("acc_noise", "m/s^2/sqrt(Hz)", 0.02, 1e-5, 5.0, (0.005, 0.1)),
        Parameter("gyro_noise", "rad/s/sqrt(Hz)", 0.001, 1e-6, 1.0, (0.0002, 0.01)),
        Parameter("acc_walk", "m/s^3/sqrt(Hz)", 0.002, 0.0, 5.0, (0.0005, 0.01)),
        Parameter("gyro_walk", "rad/s^2/sqrt(Hz)", 0.0001, 0.0, 1.0, (1e-5, 1e-3)),
    ),
    grows=("pixel", "dropout", "dropout_length", "delay", "position", "velocity", "attitude"),
    estimate=lambda values: values,
)

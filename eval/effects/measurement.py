"""Effects that are faults of the log: biased sensors, offsets of the pose, clocks that differ."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import GRAVITY, Array, Effect, Parameter, Sample, tilted_e3
from tracks.geometry.rotation import cross, exp_rot, to_world


class GyroBias(NamedTuple):
    """Values of `gyro_bias`."""

    bias: Array
    """(3,) logged minus true body rates [rad/s]."""


GYRO_BIAS = Effect(
    name="gyro_bias",
    summary="A constant error of the logged gyro values",
    equation="rate_b in the log = true + bias",
    source="sensor model",
    values=GyroBias,
    parameters=(
        Parameter("bias", "rad/s", neutral=0.0, low=-2.0, high=2.0, typical=(0.01, 0.2), size=3),
    ),
    measure=lambda values, sample: sample._replace(rate_b=sample.rate_b + values.bias),
    of_log=True,
)


class AccelerometerBias(NamedTuple):
    """Values of `accelerometer_bias`."""

    bias: Array
    """(3,) logged minus true specific force, body axes [m/s^2]."""


ACCELEROMETER_BIAS = Effect(
    name="accelerometer_bias",
    summary="A constant error of the logged accelerometer values",
    equation="acc_b in the log = true + bias",
    source="sensor model",
    values=AccelerometerBias,
    parameters=(
        Parameter("bias", "m/s^2", neutral=0.0, low=-10.0, high=10.0, typical=(0.05, 0.5), size=3),
    ),
    measure=lambda values, sample: sample._replace(acc_b=sample.acc_b + values.bias),
    of_log=True,
    needs=("acc_b",),
)


class LeverArm(NamedTuple):
    """Values of `lever_arm`."""

    offset: Array
    """(..., 3) r: the point whose position is logged, from the centre of mass, body axes [m]."""


def _on_lever_arm(values: LeverArm, sample: Sample) -> Sample:
    """Return the sample with position and velocity of the point at the end of the lever arm."""
    return sample._replace(
        pos_w=sample.pos_w + to_world(sample.rot_w, values.offset),
        vel_w=sample.vel_w + to_world(sample.rot_w, cross(sample.rate_b, values.offset)),
    )


LEVER_ARM = Effect(
    name="lever_arm",
    summary="Position and velocity are those of another point than the centre of mass",
    equation="pos_w in the log = true + R r, vel_w in the log = true + R (w x r)",
    source="rigid-body kinematics; Titterton and Weston 2004",
    values=LeverArm,
    parameters=(
        Parameter("offset", "m", neutral=0.0, low=-0.5, high=0.5, typical=(0.01, 0.06), size=3),
    ),
    measure=_on_lever_arm,
    of_log=True,
)


class AttitudeOffset(NamedTuple):
    """Values of `attitude_offset`."""

    angle: Array
    """(..., 3) rotation vector of the logged body axes from those of the gyro [rad]."""


ATTITUDE_OFFSET = Effect(
    name="attitude_offset",
    summary="The logged attitude has other body axes than gyro and rotors",
    equation="R in the log = true R exp([angle]x)",
    source="rigid-body kinematics; Titterton and Weston 2004",
    values=AttitudeOffset,
    parameters=(
        Parameter("angle", "rad", neutral=0.0, low=-0.5, high=0.5, typical=(0.02, 0.1), size=3),
    ),
    measure=lambda values, sample: sample._replace(rot_w=sample.rot_w @ exp_rot(values.angle)),
    of_log=True,
)


class FrameTilt(NamedTuple):
    """Values of `frame_tilt`."""

    angle: Array
    """(..., 2) tilt of gravity about world x, then y [rad]."""


FRAME_TILT = Effect(
    name="frame_tilt",
    summary="The log's frame is not level",
    equation="gravity = Rot(a_x, a_y, 0) (0, 0, -9.81)",
    source="motion capture that is not levelled",
    values=FrameTilt,
    parameters=(
        Parameter(
            "angle",
            "rad",
            neutral=0.0,
            low=-0.35,
            high=0.35,
            typical=(0.005, 0.035),
            size=2,
            direction=(0.6, 0.8),
        ),
    ),
    constants=lambda values, constants: constants._replace(
        gravity_w=-GRAVITY * tilted_e3(values.angle)
    ),
    of_log=True,
)


class ClockOffset(NamedTuple):
    """Values of `clock_offset`."""

    offset: Array
    """() time by which poses and velocities are logged later than they were measured [s]."""


CLOCK_OFFSET = Effect(
    name="clock_offset",
    summary="Pose and velocity are logged later than rates and commands",
    equation="row t: pose and velocity of t - offset, all other signals of t",
    source="clocks of motion capture and flight controller not aligned",
    values=ClockOffset,
    parameters=(Parameter("offset", "s", neutral=0.0, low=-0.2, high=0.2, typical=(0.002, 0.02)),),
    late=lambda values: values.offset,
    of_log=True,
)

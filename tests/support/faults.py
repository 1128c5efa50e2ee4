"""A fault of a log that is in no catalogue, for tests of what others may add."""

from typing import NamedTuple

from eval.effects import EFFECTS
from eval.effects.interface import Effect, Parameter
from tracks.geometry.rotation import exp_rot


class ImuFault(NamedTuple):
    """Values of `imu_fault`."""

    turn: tuple
    """(3,) rotation vector from the true body frame to the logged one [rad]."""
    scale: float
    """Of the logged rates [1]."""
    late: float
    """By how much poses are logged late [s]."""


def measure(values, sample):
    """Turn the body frame of the log, and scale its rates."""
    xp = sample.rot_w.__array_namespace__()
    turn = exp_rot(xp.asarray(values.turn))
    rate_b, acc_b = (xp.matmul(v[..., None, :], turn)[..., 0, :] for v in sample[3:])
    return sample._replace(
        rot_w=xp.matmul(sample.rot_w, turn), rate_b=values.scale * rate_b, acc_b=acc_b
    )


IMU_FAULT = Effect(
    name="imu_fault",
    summary="A turned and badly scaled IMU",
    equation="R in the log = R Exp(turn), rate = scale Exp(turn)^T rate",
    source="test",
    values=ImuFault,
    parameters=(
        Parameter("turn", "rad", 0.0, -0.3, 0.3, (0.01, 0.05), size=3),
        Parameter("scale", "1", 1.0, 0.5, 1.5, (0.01, 0.05)),
        Parameter("late", "s", 0.0, -0.1, 0.1, (0.002, 0.02)),
    ),
    measure=measure,
    late=lambda values: values.late,
    of_log=True,
)


def with_imu_fault(monkeypatch):
    """Let the catalogue have it, for one test."""
    monkeypatch.setitem(EFFECTS._entries, IMU_FAULT.name, IMU_FAULT)
    monkeypatch.setitem(EFFECTS._values, IMU_FAULT.name, IMU_FAULT)

"""A constant error of the logged gyroscope; the rate loop sees the true rates."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Parameter, Sample


class GyroBias(NamedTuple):
    """Values of `gyro_bias`."""

    bias: Array
    """(3,) added to the true value, body axes [rad/s]."""


def measure(values: GyroBias, sample: Sample) -> Sample:
    """Return the sample with the bias on its `rate_b`."""
    return sample._replace(rate_b=sample.rate_b + values.bias)


EFFECT = Effect(
    name="gyro_bias",
    summary="A constant error of the logged gyro values",
    equation="rate_b in the log = true + bias",
    source="sensor model",
    values=GyroBias,
    parameters=(
        Parameter(
            name="bias",
            unit="rad/s",
            neutral=0.0,
            low=-2.0,
            high=2.0,
            typical=(0.01, 0.2),
            size=3,
        ),
    ),
    measure=measure,
    of_log=True,
)

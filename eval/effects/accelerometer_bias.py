"""A constant error of the logged accelerometer."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Parameter, Sample


class AccelerometerBias(NamedTuple):
    """Values of `accelerometer_bias`."""

    bias: Array
    """(3,) added to the true value, body axes [m/s^2]."""


def measure(values: AccelerometerBias, sample: Sample) -> Sample:
    """Return the sample with the bias on its `acc_b`."""
    return sample._replace(acc_b=sample.acc_b + values.bias)


EFFECT = Effect(
    name="accelerometer_bias",
    summary="A constant error of the logged accelerometer values",
    equation="acc_b in the log = true + bias",
    source="sensor model",
    values=AccelerometerBias,
    parameters=(
        Parameter(
            name="bias",
            unit="m/s^2",
            neutral=0.0,
            low=-10.0,
            high=10.0,
            typical=(0.05, 0.5),
            size=3,
        ),
    ),
    measure=measure,
    of_log=True,
    needs=("acc_b",),
)

"""A constant error of the logged accelerometer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from eval.effects.interface import Array, Effect, Parameter


class AccelerometerBias(NamedTuple):
    """Values of `accelerometer_bias`."""

    bias: Array
    """(3,) added to the true value, body axes [m/s^2]."""


def log_of(values: AccelerometerBias, log: Mapping[str, Array]) -> dict[str, Array]:
    """Return the changed `acc_b` (T, 3), or nothing where the log has none."""
    if log.get("acc_b") is None:
        return {}
    return {"acc_b": log["acc_b"] + values.bias}


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
    log=log_of,
)

"""A rate loop that is stronger or weaker than its nominal gain."""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Constants, Effect, Parameter


class RateGain(NamedTuple):
    """Values of `rate_gain`."""

    scale: Array
    """(..., 3) true gain over nominal gain, body axes [1]."""


def constants_of(values: RateGain, constants: Constants) -> Constants:
    """Return the constants with the rate loop's gain scaled per axis."""
    return constants._replace(rate_gain=constants.rate_gain * values.scale)


EFFECT = Effect(
    name="rate_gain",
    summary="True rate-loop gain over nominal",
    equation="K = scale x nominal, per axis",
    source="flight controller tuned otherwise than believed",
    values=RateGain,
    parameters=(
        Parameter(
            name="scale",
            unit="1",
            neutral=1.0,
            low=0.1,
            high=5.0,
            typical=(0.1, 0.3),
            size=3,
            signs=(-1, 1),
        ),
    ),
    constants=constants_of,
    needs=("command",),
)

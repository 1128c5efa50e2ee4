"""Delay of the state and of the image, and its jitter.

`eval/judging/ages.py` takes each view at the physics step that precedes the decision by its age.
"""

from __future__ import annotations

from typing import NamedTuple

from eval.sensors.interface import Ages, Parameter, Sensor


class Delay(NamedTuple):
    """Values of `delay`."""

    state: float
    image: float
    jitter: float


def ages(values: Delay) -> Ages:
    """Return the ages."""
    return Ages(*map(float, values))


SENSOR = Sensor(
    name="delay",
    stage="state",
    summary="State and image are delayed when the policy decides",
    equation="seen(t) = true(t - a), a = age (1 + jitter u), u even from -1 to 1 each decision",
    source="Falanga et al. 2019 (latency of vision in flight): 10 to 100 ms",
    values=Delay,
    parameters=(
        Parameter("state", "s", 0.0, 0.0, 1.0, (0.005, 0.05)),
        Parameter("image", "s", 0.0, 0.0, 1.0, (0.01, 0.1)),
        Parameter("jitter", "1", 0.0, 0.0, 1.0, (0.1, 1.0)),
    ),
    grows=("state", "image"),
    ages=ages,
)

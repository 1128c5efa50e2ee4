"""A sensor model of another program that would give wrong numbers is refused."""

from dataclasses import replace
from itertools import count
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from eval.sensors import SENSORS
from eval.sensors.interface import Needs, Parameter, Sensor
from eval.sensors.sense_check import sensor_problem
from tests.support.marks import more

CALLS = count(1)


class Shake(NamedTuple):
    """Values of the model `shake`."""

    size: Any


def sense(values, memory, seen, moment):
    error_w = values.size[..., None] * moment.draws.normal
    return seen._replace(pos_w=seen.pos_w + error_w), memory


SIZE = Parameter("size", "m", 0.0, 0.0, 1.0, (0.01, 0.1))
SHAKE = Sensor(
    name="shake",
    stage="state",
    summary="",
    equation="",
    source="",
    values=Shake,
    parameters=(SIZE,),
    grows=("size",),
    observation=Needs(normal=3),
    sense=sense,
)


def changed(**fields):
    """Return a model's `sense` that replaces fields of the view, made from it."""
    return lambda values, memory, seen, moment: (
        seen._replace(**{name: make(values, seen) for name, make in fields.items()}),
        memory,
    )


def write(values, memory, seen, moment):
    seen.pos_w[...] += 0.1
    return seen, memory


@pytest.mark.parametrize("name", [more(one) if n > 3 else one for n, one in enumerate(SENSORS)])
def test_the_suites_models_pass(name):
    assert sensor_problem(SENSORS[name]) is None


def test_a_model_may_be_checked_while_jax_traces_a_function():
    problems = []

    def traced(number):
        problems.append(sensor_problem(SHAKE))
        return number + 1.0

    assert jax.jit(traced)(1.0) == 2.0 and problems == [None]


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"stage": "states"}, "stage is 'states'"),
        ({"sense": None}, "without a function"),
        ({"parameters": (SIZE._replace(low=0.1),)}, "from 0.1 to 1 and neutral at 0"),
        ({"parameters": (SIZE._replace(high=np.inf),)}, "from 0 to inf .*all finite"),
        ({"sense": changed(pos_w=lambda v, s: s.pos_w[0])}, r"pos_w of shape \(3,\)"),
        ({"sense": changed(depth_m=lambda v, s: s.depth_m * np.nan)}, "depth_m that is not finite"),
        ({"sense": changed(vel_w=lambda v, s: np.abs(s.vel_w))}, "TracerArrayConversion"),
        ({"sense": changed(vel_w=lambda v, s: 1.1 * s.vel_w)}, "vel_w at the neutral values"),
        (
            {"sense": changed(vel_w=lambda v, s: s.vel_w + v.size[..., None] * next(CALLS))},
            "in a second call",
        ),
        ({"sense": changed(vel_w=lambda v, s: s.vel_w + v.size)}, "could not be broadcast"),
        ({"sense": lambda v, memory, seen, moment: seen}, "fails with"),
        ({"sense": lambda v, memory, seen, moment: (seen, seen.pos_w)}, "memory of another form"),
        ({"sense": write}, "read-only"),
        ({"observation": Needs()}, "fails with"),
    ],
)
def test_a_model_that_would_give_wrong_numbers_is_refused(fields, said):
    assert sensor_problem(SHAKE) is None
    with pytest.raises(ValueError, match=f"'shake'.*{said}"):
        SENSORS.register("shake", replace(SHAKE, **fields))
    assert "shake" not in SENSORS

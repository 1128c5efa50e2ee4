"""An effect of another program whose hooks would give wrong numbers is refused, with the hook."""

from dataclasses import replace
from itertools import count
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from eval.effects import EFFECTS
from eval.effects.hook_check import hook_problem, parameter_problem
from eval.effects.interface import Effect, Parameter, per_axis
from tests.support.marks import more

CALLS = count(1)


class Spring(NamedTuple):
    """Values of the effect `spring`."""

    stiffness: Any


K = Parameter("stiffness", "N/m", neutral=0.0, low=0.0, high=10.0, typical=(0.02, 0.2))


def pull(values, flow):
    return -per_axis(values.stiffness) * flow.pos_w


SPRING = Effect(
    name="spring",
    summary="",
    equation="",
    source="",
    values=Spring,
    parameters=(K,),
    force=pull,
)


def speed(vector, xp):
    return xp.sqrt((vector**2).sum(-1))


def write(values, flow):
    flow.air_vel_b[...] = 0.0
    return pull(values, flow)


# The steppers' gradients are tested by every effect in flight, too.
@pytest.mark.parametrize(
    "name", [more(name) if effect.in_flight else name for name, effect in EFFECTS.items()]
)
def test_the_suites_effects_pass(name):
    assert parameter_problem(EFFECTS[name]) is hook_problem(EFFECTS[name]) is None


def test_an_effect_may_be_checked_while_jax_traces_a_function():
    problems = []

    def traced(number):
        problems.append(hook_problem(SPRING))
        return number + 1.0

    assert jax.jit(traced)(1.0) == 2.0 and problems == [None]


@pytest.mark.parametrize(
    ("force", "said"),
    [
        (lambda v, flow: -v.stiffness * flow.pos_w, "could not be broadcast"),
        (lambda v, flow: -v.stiffness * flow.pos_w[..., 2], r"shape \(5,\), must be \(5, 3\)"),
        (lambda v, flow: [0.0, 0.0, 0.0], "returns a list"),
        (lambda v, flow: None, "returns a NoneType"),
        (lambda v, flow: per_axis(v.stiffness) * np.abs(flow.pos_w), "TracerArrayConversion"),
        (lambda v, flow: flow.pos_w if v.stiffness.max() > 0 else 0 * flow.pos_w, "TracerBool"),
        (lambda v, flow: 0.0 * flow.pos_w / per_axis(v.stiffness), "numbers that are not finite"),
        (lambda v, flow: per_axis(1.0 + v.stiffness) * flow.pos_w, "at the neutral values"),
        (lambda v, flow: next(CALLS) * pull(v, flow), "in a second call"),
        (write, "read-only"),
        (
            lambda v, flow: (
                per_axis(v.stiffness * speed(flow.air_vel_b, flow.pos_w.__array_namespace__()))
                * flow.air_vel_b
            ),
            "derivative that is not finite",
        ),
        (None, "without a hook"),
    ],
)
def test_a_hook_that_would_give_wrong_numbers_is_refused(force, said):
    assert hook_problem(SPRING) is None
    with pytest.raises(ValueError, match=f"'spring'.*{said}"):
        EFFECTS.register("spring", replace(SPRING, force=force))
    assert "spring" not in EFFECTS


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"low": 1.0, "high": 0.0}, "from 1 to 0"),
        ({"high": np.inf}, "all finite"),
        ({"unseen": (3,)}, r"unseen components \(3,\)"),
        ({"neutral": -1.0}, "neutral at -1"),
        ({"neutral": np.nan}, "neutral at nan"),
        ({"typical": (0.2, 0.02)}, "usual sizes"),
        ({"typical": (0.0, 0.02)}, "usual sizes"),
        ({"typical": 0.1}, "cannot be checked .TypeError"),
        ({"size": 3}, "could not be broadcast"),
    ],
)
def test_bounds_that_contradict_each_other_are_refused(changes, said):
    with pytest.raises(ValueError, match=f"'spring'.*{said}"):
        EFFECTS.register("spring", replace(SPRING, parameters=(replace(K, **changes),)))

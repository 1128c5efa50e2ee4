"""A name that one flight alone carries is no name where the model is off."""

import numpy as np

from suite.diagnose.estimate.block import NormalEquations
from suite.diagnose.estimate.composites import composites
from suite.diagnose.estimate.gauss_newton import chi2_by_group, chi2_fall
from suite.diagnose.estimate.parameters import candidates, make_space
from suite.diagnose.evidence.evidence import flights_agree
from suite.diagnose.search.search import could_be_best, needs_all_parts
from suite.diagnose.thresholds import THRESHOLDS
from tests.support.vehicles import PLAIN

FLIGHT = np.repeat(np.arange(4), 6)


def made_equations(space, sizes, rng):
    """24 windows of four flights, in each of which the first number has another of `sizes`."""
    step = space.array("step")
    slope = rng.standard_normal((24, 40, len(step))) / step
    residual = 0.1 * rng.standard_normal((24, 40))
    residual += np.array(sizes)[FLIGHT][:, None] * slope[..., 0] * step[0]
    turned = np.swapaxes(slope, 1, 2)
    return NormalEquations(
        turned @ slope, (turned @ residual[..., None])[..., 0], (residual**2).sum(1)
    )


def gains_of(sizes):
    space = make_space(PLAIN)
    theta = 0.5 * (space.array("low") + space.array("high"))
    made = made_equations(space, sizes, np.random.default_rng(0))
    assert chi2_fall(made, theta, space, [0]) > 10.0
    assert chi2_fall(made, theta, space, []) == 0.0
    without, with_it = (
        chi2_by_group(made.along_numbers(at), theta, space, FLIGHT) for at in ([1], [0, 1])
    )
    return without - with_it


def test_what_all_flights_have_is_agreed_on():
    gains = gains_of([0.3, 0.25, 0.35, 0.3])
    assert (gains > 0.0).all() and flights_agree(gains)


def test_what_flights_contradict_is_not():
    gains = gains_of([1.5, -0.4, -0.4, 0.3])
    assert not flights_agree(gains)
    assert not flights_agree(np.array([100.0, 0.5, 0.2, -3.0]))
    assert flights_agree(np.array([5.0, -1.0]))


def test_several_effects_have_to_explain_more_than_each_of_them_alone():
    single = candidates(make_space(PLAIN), False, ())
    payload = next(one for one in composites(single) if "mass_offset" in one.effects)
    mass, com = payload.parts
    costs = {payload: 100.0, mass: 105.0, com: 300.0}
    assert [one for one in costs if needs_all_parts(costs, one, THRESHOLDS)] == [mass, com]
    assert needs_all_parts({**costs, payload: 90.0}, payload, THRESHOLDS)
    fallen = {payload: 100.0, mass: 95.0, com: 10.0}
    assert not could_be_best(fallen, payload, THRESHOLDS)
    assert could_be_best({**fallen, mass: 50.0}, payload, THRESHOLDS)

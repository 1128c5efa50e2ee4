"""Effects that are one hypothesis, and when a hypothesis is preferred to another."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suite.diagnose.estimate.block import NormalEquations
from suite.diagnose.estimate.composites import (
    acts_through,
    begin_of,
    composites,
    in_words,
    inactive_at,
    usual_size,
)
from suite.diagnose.estimate.gauss_newton import chi2_by_group, chi2_fall
from suite.diagnose.estimate.parameters import candidates, effects_in, make_space
from suite.diagnose.evidence.evidence import flights_agree
from suite.diagnose.search.evaluation import Evaluation, linear_change
from suite.diagnose.search.search import could_be_best, needs_all_parts
from suite.diagnose.thresholds import THRESHOLDS
from tests.support.vehicles import PLAIN

SPACE = make_space(PLAIN)
START = SPACE.array("start")
SINGLE = candidates(SPACE, False, ())
WHOLE = {one.name: one for one in composites(SINGLE)}
WIND, PAYLOAD = WHOLE["constant_wind + linear_drag"], WHOLE["mass_offset + com_offset"]


def places(effect):
    return [i for i, entry in enumerate(SPACE.entries) if entry.effect == effect]


def equations_of(slope, residual, **more):
    """Return the normal equations of windows with `slope` (W, N, K) and `residual` (W, N)."""
    turned = np.swapaxes(slope, 1, 2)
    cross = (turned @ residual[..., None])[..., 0]
    return NormalEquations(turned @ slope, cross, (residual**2).sum(1), **more)


def test_a_composite_has_the_parameters_of_all_its_parts():
    assert WIND.effects == effects_in(WIND.name) == ("constant_wind", "linear_drag")
    assert list(WIND.indices) == sorted(places("constant_wind") + places("linear_drag"))
    assert [part.name for part in WIND.parts] == list(WIND.effects)
    without_drag = composites([one for one in SINGLE if one.name != "linear_drag"])
    assert WIND.name not in {one.name for one in without_drag}
    assert acts_through(WIND) and not acts_through(PAYLOAD)


def test_a_wind_gets_slopes_of_a_usual_drag_only_where_no_drag_passes_it_on():
    theta, acts = START.copy(), np.ones(len(START), bool)
    assert inactive_at(SPACE, theta, [WIND], acts) is None
    acts[places("constant_wind")] = False
    found = inactive_at(SPACE, theta, [WIND], acts)
    assert found is not None and list(found.indices) == places("constant_wind")
    np.testing.assert_allclose(found.theta[places("linear_drag")], 0.35)
    assert inactive_at(SPACE, theta, SINGLE, acts) is None
    theta[places("constant_wind")[0]] = 1.0
    assert inactive_at(SPACE, theta, [WIND], acts) is None


@pytest.mark.parametrize("drag_change", [0.7, pytest.param(-0.5, id="hovering flights need none")])
def test_a_fit_begins_where_drag_times_wind_is_that_of_the_linear_fit(drag_change):
    drag, wind = places("linear_drag"), places("constant_wind")
    change = np.zeros(len(START))
    change[drag], change[wind] = drag_change, 2.0
    begin = begin_of(SPACE, START, WIND, wind, change, np.ones(len(START)))
    assert begin[drag].min() > 0.0
    assert begin[drag] * begin[wind] == pytest.approx(usual_size(SPACE)[drag] * 2.0)


def test_a_linear_fit_of_a_composite_uses_the_second_columns_of_its_inactive_part():
    size, wind = len(START), tuple(places("constant_wind"))
    slope = np.random.default_rng(0).standard_normal((5, 40, size + 3))
    slope /= np.append(SPACE.array("step"), [1.0] * 3)
    slope[..., list(wind)] = 0.0
    made = equations_of(slope, slope[..., size:] @ [1.0, -2.0, 0.5], along=(*range(size), *wind))
    assert tuple(made.columns_of(WIND.parts[0])) == wind
    assert sorted(made.numbers[c] for c in made.columns_of(WIND)) == list(WIND.indices)
    named: Any = SimpleNamespace(space=SPACE, theta=START, equations=made)
    change, information = linear_change(Evaluation(named, named, named), [], WIND)
    np.testing.assert_allclose(change[list(wind)], [1.0, -2.0, 0.5], atol=1e-3)
    assert (information[list(wind)] > 0.0).all() and not information[places("frame_tilt")].any()


def test_lines_name_effects_that_belong_together_and_composites_among_alternatives():
    assert in_words([("linear_drag", "rotor_drag"), ("mass_offset",)]) == []
    (both,) = in_words([("constant_wind",), ("linear_drag",)])
    assert "belong together" in both
    (one,) = in_words([("frame_tilt", "thrust_tilt", WIND.name)])
    assert one.startswith(WIND.name) and "one hypothesis" in one


@pytest.mark.parametrize(
    ("sizes", "agree"), [([0.3, 0.25, 0.35, 0.3], True), ([1.5, -0.4, -0.4, 0.3], False)]
)
def test_flights_agree_on_what_all_of_them_have(sizes, agree):
    flight, rng = np.repeat(np.arange(4), 6), np.random.default_rng(0)
    theta = 0.5 * (SPACE.array("low") + SPACE.array("high"))
    slope = rng.standard_normal((24, 40, len(START))) / SPACE.array("step")
    residual = 0.1 * rng.standard_normal((24, 40))
    residual += np.array(sizes)[flight, None] * slope[..., 0] * SPACE.array("step")[0]
    made = equations_of(slope, residual)
    assert chi2_fall(made, theta, SPACE, [0]) > 10.0 > chi2_fall(made, theta, SPACE, []) == 0.0
    without, with_it = (
        chi2_by_group(made.along_numbers(at), theta, SPACE, flight) for at in ([1], [0, 1])
    )
    assert flights_agree(without - with_it) == agree


def test_flights_disagree_where_one_of_them_decides():
    assert not flights_agree(np.array([100.0, 0.5, 0.2, -3.0]))
    assert flights_agree(np.array([5.0, -1.0])), "two flights are too few to judge"


def test_several_effects_have_to_explain_more_than_each_of_them_alone():
    mass, com = PAYLOAD.parts
    chi2 = {PAYLOAD: 100.0, mass: 105.0, com: 300.0}
    assert [one for one in chi2 if needs_all_parts(chi2, one, THRESHOLDS)] == [mass, com]
    assert needs_all_parts({**chi2, PAYLOAD: 90.0}, PAYLOAD, THRESHOLDS)
    falls = {PAYLOAD: 100.0, mass: 95.0, com: 10.0}
    assert not could_be_best(falls, PAYLOAD, THRESHOLDS)
    assert could_be_best({**falls, mass: 50.0}, PAYLOAD, THRESHOLDS)

"""A change that shows in motion alone is told; other manoeuvres of the same vehicle are none."""

import numpy as np
import pytest

from suite.diagnose.data.flights import ready
from suite.diagnose.data.view import FORCE
from suite.diagnose.estimate.parameters import candidates, make_space
from suite.diagnose.evidence.moments import ForceModel, ViewData
from suite.diagnose.evidence.views import ViewEvidence
from suite.diagnose.search.change import fit_each_flight, search_motion_change, within_flights
from tests.support.real_flights import VEHICLE, flights

SPACE = make_space(VEHICLE)
DRAG, MORE = (0.4, 0.3, 0.2), (0.6, 0.5, 0.2)
"""The vehicle file has no drag at all."""


def task_of(logs):
    model = ForceModel(VEHICLE, SPACE, False)
    return ViewEvidence(FORCE, model, ready(logs, VEHICLE).smoothed[FORCE.name])


@pytest.fixture(scope="module")
def before():
    return task_of(flights(3, seed=5, linear_drag=(DRAG,)))


def test_more_drag_is_told_with_its_whole_size(before):
    after = task_of(flights(3, seed=6, speed=2.5, linear_drag=(MORE,)))
    found = search_motion_change(before, after, candidates(SPACE, False, ()))
    assert found is not None
    (name,) = found.named
    assert name.candidate.name == "linear_drag"
    np.testing.assert_allclose(found.estimate.theta[found.indices], MORE, atol=0.06)
    np.testing.assert_allclose(found.start.theta[found.indices], DRAG, atol=0.06)


def test_other_speeds_of_the_same_vehicle_are_no_change(before):
    after = task_of(flights(3, seed=7, speed=2.0, linear_drag=(DRAG,)))
    assert search_motion_change(before, after, candidates(SPACE, False, ())) is None


def test_each_flights_own_number_knows_no_trim():
    rng = np.random.default_rng(0)
    flight, slope = np.repeat([0, 1], 200), rng.standard_normal((400, 3, 2))
    true, trim = np.array([[0.5, -1.0], [0.7, 0.0]]), np.array([3.0, -2.0])
    residual = np.einsum("mak,mk->ma", slope, true[flight]) + trim[flight, None]
    data = ViewData(flight, np.arange(400.0), residual, residual, slope, np.zeros((400, 3, 0)))
    found = fit_each_flight(within_flights(data), [0, 1], np.ones(3))
    np.testing.assert_allclose(found, true, atol=1e-9)

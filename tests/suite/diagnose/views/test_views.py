"""Diagnoses by views, end to end: names, gaps, what a black box could do, reports, errors."""

import numpy as np
import pytest

from suite.diagnose.views.by_views import diagnose_by_views
from suite.diagnose.views.explainable import closed_share, fit_black_box, inputs_of
from suite.diagnose.views.fit.by_flight import centred
from suite.diagnose.views.judged import judge
from tests.support.real_flights import VEHICLE, flights

DRAG = (0.4, 0.3, 0.2)


@pytest.fixture(scope="module")
def found():
    return diagnose_by_views(flights(4, linear_drag=(DRAG,)), VEHICLE)


def test_a_drag_is_named_and_closes_what_any_model_could(found):
    assert found.verdict == "named" and found.warnings == []
    assert found.vehicle.effects["linear_drag"].coefficient[0] == pytest.approx(0.4, abs=0.05)
    force = found.main.gap
    assert force.share(force.closed) > 0.8 > 0.3 * force.share(force.explainable)
    assert force.rms(force.after) < 0.6 * force.rms(force.before)
    assert len(found.held_out) == 1


def test_what_was_judged_can_be_judged_again(found):
    one = found.main
    again = judge(one.search, one.held, one.gap.floor)
    assert np.allclose(again.after, one.gap.after)


def test_the_vehicle_itself_has_no_gap():
    none = diagnose_by_views(flights(3, seed=2), VEHICLE)
    assert (none.verdict, none.named) == ("no_gap", [])


def test_a_black_box_closes_what_goes_with_what_was_flown_and_no_noise(found):
    fitted = found.main.search.task.flights
    inputs = np.concatenate([inputs_of(flight) for flight in fitted])
    flight = found.main.search.first.data.flight
    noise = np.random.default_rng(0).standard_normal((len(flight), 3))
    said = fit_black_box(inputs, noise, flight).predict(inputs)
    assert closed_share(noise, noise - said, flight).max() < 0.2
    real = 2.0 * inputs[:, [0, 1, 2]] + 0.1 * noise
    left = real - fit_black_box(inputs, real, flight).predict(inputs)
    assert closed_share(real, left, flight).min() > 0.8
    assert np.abs(centred(real, flight)[flight == 0].mean(axis=0)).max() < 1e-12


def test_a_lone_reference_flight_is_refused():
    logs = flights(2, seed=4)
    with pytest.raises(ValueError, match="at least 2"):
        diagnose_by_views(logs[:1], VEHICLE, logs[1:])

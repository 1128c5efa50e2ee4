"""What has changed since reference flights, by trims or by how the vehicle moves."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.data.flights import ready
from suite.diagnose.data.view import FORCE, TORQUE
from suite.diagnose.estimate.parameters import candidates, make_space
from suite.diagnose.evidence.moments import ForceModel, ViewData
from suite.diagnose.evidence.views import ViewEvidence, view_candidates
from suite.diagnose.search import change
from suite.diagnose.search.search import search
from suite.diagnose.thresholds import THRESHOLDS
from tests.support.real_flights import VEHICLE, flights

SPACE = make_space(VEHICLE)
DRAG = (0.4, 0.3, 0.2)


def task_of(logs, view=FORCE):
    smoothed = ready(logs, VEHICLE).smoothed[view.name]
    return ViewEvidence(view, ForceModel(VEHICLE, SPACE, False), smoothed)


def named(found):
    return [name.candidate.label for name in found.named]


@pytest.fixture(scope="module")
def before():
    """Return reference flights, by view, of a vehicle that the file describes wrongly."""
    logs = flights(3, 5, 5.0, 1.0, thrust_scale=(0.9,), linear_drag=(DRAG,))
    return {view.name: task_of(logs, view) for view in (FORCE, TORQUE)}


@pytest.mark.parametrize("share", [0.8, pytest.param(1.0, marks=pytest.mark.slow)])
def test_a_change_stands_out_of_how_flights_differ_though_the_file_is_wrong(before, share):
    motor = {"weak_motor": ((1.0, 1.0, share, 1.0),)} if share < 1.0 else {}
    logs = flights(3, 6, 5.0, 1.0, thrust_scale=(0.9,), linear_drag=(DRAG,), **motor)
    after = {view.name: task_of(logs, view) for view in (FORCE, TORQUE)}
    spread = change.rotor_spread([*before.values(), *after.values()])
    found = {}
    for name, task in after.items():
        evidence, start = change.change_evidence(before[name], task.flights, spread)
        known = evidence.relinearise(start)
        among = view_candidates(candidates(SPACE, False, ()), known[1])
        found[name] = named(search(evidence, start, among, known=known))
        if share < 1.0:
            # Only what comes near the best may stand in its place: otherwise a more usual effect
            # replaces the right one.
            scores = evidence.scores(known[1], known[1].equations, start.theta, [], among, 0)
            assert 0 < len(scores) < len(among)
            assert scores[-1].gain >= THRESHOLDS.near_share * scores[0].gain
    assert (found == {"force": [], "torque": []}) == (share == 1.0)
    assert share == 1.0 or "weak_motor 3" in found["torque"]


def test_an_axis_along_which_flights_are_alike_has_a_spread_of_its_own():
    logs = flights(3, 5, 3.0, trim=0.0)
    force, torque = task_of(logs), task_of(logs, TORQUE)
    apart = [
        flight._replace(measured=flight.measured + push * np.array([1.0, 1.0, 0.1]))
        for flight, push in zip(torque.flights, (-2.0, 0.0, 2.0), strict=True)
    ]
    spread = change.rotor_spread([force, replace(torque, flights=apart)])
    prior, own = THRESHOLDS.spread_freedom, 2
    assert spread.freedom == 4 * own
    assert {view: list(one) for view, one in spread.freedom_along.items()} == {
        "force": [0, 0, own],
        "torque": [own, own, own],
    }
    quiet = spread.share * np.sqrt(prior / (prior + own))
    assert quiet <= spread.along["force"][2] < 1.05 * quiet
    assert (spread.along["torque"] > spread.share).all()


def test_sizes_are_drawn_as_the_spread_is_estimated():
    spread = change.RotorSpread(
        0.01, 8, {}, {"force": np.array([0, 0, 2]), "torque": np.full(3, 2)}, 4
    )
    sizes = {
        view: spread.variance_ratios(view, 20000, np.random.default_rng(1))
        for view in ("force", "torque")
    }
    assert sizes["force"].mean(axis=0) == pytest.approx(np.ones(3), rel=0.02)
    # Axes without an estimate have the spread of all: a chi-square of 8 degrees over 8.
    assert sizes["force"][:, 0].var() == pytest.approx(2.0 / 8.0, rel=0.05)
    own, shared = 2.0 * 2.0, 2.0 * 8.0  # variances of the sums of squares
    both = (4.0 / 8.0) ** 2 * shared + own + 2.0 * (4.0 / 8.0) * own
    assert sizes["torque"].var(axis=0) == pytest.approx(np.full(3, both / 36.0), rel=0.05)


def test_more_drag_is_named_with_its_whole_size_and_other_speeds_are_no_change(monkeypatch):
    p_values, welch = list[float](), change.ttest_ind

    def spy(*fits, **options):
        result = welch(*fits, **options)
        p_values.extend(result.pvalue)
        return result

    monkeypatch.setattr(change, "ttest_ind", spy)
    more, dragged = (0.6, 0.5, 0.2), task_of(flights(3, 5, 5.0, linear_drag=(DRAG,)))
    after = task_of(flights(3, 6, 5.0, 2.5, linear_drag=(more,)))
    found = change.search_motion_change(dragged, after, candidates(SPACE, False, ()), 2)
    assert found is not None and named(found) == ["linear_drag"]
    # Bonferroni: the least p-value, which is the drag's, times the number of all of them, for
    # two views.
    assert found.named[0].p_value == pytest.approx(2 * len(p_values) * min(p_values))
    np.testing.assert_allclose(found.estimate.theta[found.indices], more, atol=0.06)
    np.testing.assert_allclose(found.start.theta[found.indices], DRAG, atol=0.06)
    after = task_of(flights(3, 7, 5.0, 2.0, linear_drag=(DRAG,)))
    assert change.search_motion_change(dragged, after, candidates(SPACE, False, ()), 2) is None


def test_the_fit_of_each_flight_ignores_its_trim():
    rng = np.random.default_rng(0)
    flight, slope = np.repeat([0, 1], 200), rng.standard_normal((400, 3, 2))
    true, trim = np.array([[0.5, -1.0], [0.7, 0.0]]), np.array([3.0, -2.0])
    residual = np.einsum("mak,mk->ma", slope, true[flight]) + trim[flight, None]
    data = ViewData(flight, np.arange(400.0), residual, residual, slope, np.zeros((400, 3, 0)))
    equations = change.equations_by_flight(change.within_flights(data), np.ones(3))
    found = change.fit_each_flight(equations)
    np.testing.assert_allclose(found, true, atol=1e-9)

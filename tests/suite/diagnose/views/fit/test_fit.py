"""The model on measured rows, weights of flights with trims, and the searches for names."""

import numpy as np
import pytest

from suite.diagnose.data.flights import ready
from suite.diagnose.data.view import FORCE, TORQUE
from suite.diagnose.estimate.composites import composites
from suite.diagnose.estimate.gauss_newton import chi2_by_group
from suite.diagnose.estimate.parameters import (
    Candidate,
    at_bound,
    candidates,
    implausible,
    make_space,
    usual_first,
)
from suite.diagnose.evidence.moments import (
    ForceModel,
    ViewData,
    Weights,
    block_of,
    centred,
    compare,
    means_of,
    stretch_numbers,
    validation_groups,
    weights_of,
    whitened,
)
from suite.diagnose.evidence.views import ViewEvidence, view_candidates
from suite.diagnose.search.search import search
from suite.diagnose.thresholds import THRESHOLDS
from tests.support.real_flights import VEHICLE, flights
from tests.support.vehicles import with_effects

SPACE = make_space(VEHICLE)
DRAG = (0.4, 0.3, 0.2)


def task_of(logs, view=FORCE, vehicle=VEHICLE):
    model = ForceModel(vehicle, make_space(vehicle), False)
    return ViewEvidence(view, model, ready(logs, vehicle).smoothed[view.name])


@pytest.fixture(scope="module")
def dragged():
    return flights(4, linear_drag=(DRAG,))


def names_of(task):
    known = task.estimate_noise(task.start)
    among = view_candidates(candidates(SPACE, False, ()), known[1])
    return search(known[0], task.start, among, known=known)


def made(rng, count=6, moments=200, trim=(0.5, 0.0, 2.0), scatter=0.3):
    flight = np.repeat(np.arange(count), moments)
    means = rng.standard_normal((count, 3)) * trim
    residual = scatter * rng.standard_normal((count * moments, 3)) + means[flight]
    middle = np.tile(np.arange(moments) * 0.1, count)
    slope, none = np.ones((len(flight), 3, 1)), np.zeros((len(flight), 3, 0))
    return ViewData(flight, middle, 0.0 * residual, residual, slope, none)


def test_the_vehicle_itself_leaves_only_noise_and_a_drag_leaves_the_drag(dragged):
    task = task_of(flights(1, trim=0.0))
    data = compare(FORCE, task.model, SPACE.array("start"), task.flights)
    assert np.abs(data.residual.mean(axis=0)).max() < 0.03
    true = with_effects(VEHICLE, linear_drag=(DRAG,))
    with_it, without = task_of(dragged, vehicle=true), task_of(dragged)
    power = [
        (compare(FORCE, t.model, t.model.space.array("start"), t.flights).residual ** 2).mean()
        for t in (with_it, without)
    ]
    assert power[0] < 0.1 * power[1]


def test_slopes_are_those_of_finite_differences():
    task, theta = task_of(flights(1)), SPACE.array("start")
    first = compare(FORCE, task.model, theta, task.flights)
    for index in (0, 10, 25):
        moved = theta.copy()
        moved[index] += 1e-5
        change = compare(FORCE, task.model, moved, task.flights).value - first.value
        assert np.allclose(change / 1e-5, first.slope[..., index], atol=1e-4, rtol=1e-3)


def test_trims_of_flights_are_told_from_scatter_within_them():
    weights = weights_of(made(np.random.default_rng(1), count=60))
    assert weights.scatter == pytest.approx([0.3, 0.3, 0.3], rel=0.05)
    assert weights.trim == pytest.approx([0.5, 0.0, 2.0], abs=0.35)
    assert np.isinf(weights_of(made(np.random.default_rng(1), count=2)).trim).all()


def test_weighed_moments_of_flights_with_trims_are_independent_units():
    rng = np.random.default_rng(2)
    weights = Weights(np.full(3, 0.3), np.ones(3), np.array([0.5, 0.0, 2.0]))
    means, within = [], []
    for _ in range(200):
        data = made(rng, count=1, moments=50)
        residual, _ = whitened(data, weights)
        means.append(residual.sum(axis=0) / np.sqrt(50))
        within.append(residual.std(axis=0))
    assert np.std(means, axis=0) == pytest.approx([1.0, 1.0, 1.0], rel=0.2)
    assert np.mean(within, axis=0) == pytest.approx([1.0, 1.0, 1.0], rel=0.05)


def test_blocks_stand_apart_and_a_flight_has_one_mean():
    data = made(np.random.default_rng(3), count=2, moments=60)
    stretch = stretch_numbers(data)
    assert stretch.max() + 1 == 2 * 3  # 6 s in blocks of 2 s
    weights = weights_of(data)
    assert block_of(data, weights, stretch, [0]).slope.shape == (6, 60, 1)


def test_flights_have_means_and_a_lone_one_has_thirds():
    flight, values = np.array([2, 2, 5, 5, 5]), np.array([[1.0], [3.0], [0.0], [3.0], [6.0]])
    assert means_of(values, flight).ravel().tolist() == [2.0, 3.0]
    assert centred(values, flight).ravel().tolist() == [-1.0, 1.0, -3.0, 0.0, 3.0]
    assert validation_groups(flight).tolist() == flight.tolist()
    assert validation_groups(np.zeros(6)).tolist() == [0, 0, 1, 1, 2, 2]


def test_a_drag_is_named_with_its_numbers_by_flights_that_agree(dragged):
    found = names_of(task_of(dragged))
    (name,) = found.named
    assert name.candidate.name == "linear_drag" and (np.array(name.gains) > 0.0).all()
    at = list(name.candidate.indices)
    width = found.half_widths()
    assert (np.abs(found.estimate.theta[at] - DRAG) < 2.0 * width + 0.02).all()
    assert width[:2].max() < 0.1


def test_trims_that_differ_from_flight_to_flight_are_no_effect():
    logs = flights(4, seed=3)
    for view in (FORCE, TORQUE):
        assert names_of(task_of(logs, view)).named == ()


def test_a_flight_is_judged_by_what_the_others_say(dragged):
    task = task_of(dragged)
    drag = [i for i, entry in enumerate(SPACE.entries) if entry.effect == "linear_drag"]
    evidence, block = task.estimate_noise(task.start)
    equations, theta, part = block.equations, task.start.theta, evidence.groups(block)
    without, with_it = (
        chi2_by_group(equations.along_numbers(at), theta, SPACE, part) for at in ([], drag)
    )
    gains = without - with_it
    assert gains.shape == (4,) and (gains > 0.0).all()


def test_sizes_beyond_three_times_the_usual_are_implausible():
    at = [i for i, entry in enumerate(SPACE.entries) if entry.effect == "frame_tilt"]
    tilt = Candidate("frame_tilt", tuple(at), "frame_tilt")
    theta = SPACE.array("start")
    assert implausible(SPACE, theta, tilt) == []
    theta[at[0]] = 1.1 * THRESHOLDS.implausible_times * 0.035
    assert len(implausible(SPACE, theta, tilt)) == 1
    assert not at_bound(SPACE, theta, tilt)
    theta[at[0]] = SPACE.array("high")[at[0]]
    assert at_bound(SPACE, theta, tilt)
    assert usual_first(SPACE, theta, tilt) > usual_first(SPACE, SPACE.array("start"), tilt)
    whole = next(one for one in composites(candidates(SPACE, False, ())) if "wind" in one.name)
    start = SPACE.array("start")
    assert usual_first(SPACE, start, tilt) < usual_first(SPACE, start, whole)
    assert usual_first(SPACE, start, whole) < usual_first(SPACE, theta, tilt)
    start[list(whole.indices)] = 20.0
    assert any("constant_wind velocity" in told for told in implausible(SPACE, start, whole))
    drag = [i for i, entry in enumerate(SPACE.entries) if entry.effect == "linear_drag"]
    assert not at_bound(SPACE, theta, Candidate("linear_drag", tuple(drag), "linear_drag"))

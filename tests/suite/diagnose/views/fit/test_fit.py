"""The model on measured rows, weights of flights with a trim each, and slow and fast changes."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from suite.diagnose.data.flights import ready
from suite.diagnose.data.view import FORCE
from suite.diagnose.estimate.composites import composites
from suite.diagnose.estimate.parameters import (
    Candidate,
    at_bound,
    candidates,
    implausible,
    make_space,
    usual_first,
)
from suite.diagnose.evidence.evidence import validation_groups
from suite.diagnose.evidence.moments import (
    ForceModel,
    ViewData,
    Weights,
    fast_changes_agree,
    fast_share,
    successive_changes,
    weights_of,
    whitened,
)
from suite.diagnose.evidence.views import ViewEvidence
from suite.diagnose.thresholds import THRESHOLDS
from tests.support.real_flights import VEHICLE, flights

SPACE = make_space(VEHICLE)


def made(rng, count=6, moments=200, trim=(0.5, 0.0, 2.0), scatter=0.3):
    flight = np.repeat(np.arange(count), moments)
    means = rng.standard_normal((count, 3)) * trim
    residual = scatter * rng.standard_normal((count * moments, 3)) + means[flight]
    middle = np.tile(np.arange(moments) * 0.1, count)
    slope, none = np.ones((len(flight), 3, 1)), np.zeros((len(flight), 3, 0))
    return ViewData(flight, middle, 0.0 * residual, residual, slope, none)


def test_slopes_are_those_of_finite_differences():
    model, theta = ForceModel(VEHICLE, SPACE, False), SPACE.array("start")
    smoothed = ready(flights(1, duration_s=4.0), VEHICLE).smoothed[FORCE.name]
    evidence = ViewEvidence(FORCE, model, smoothed)
    first = evidence.residuals(theta, None)
    for index in (0, 10, 25):
        moved = theta.copy()
        moved[index] += 1e-5
        change = evidence.residuals(moved).value - first.value
        assert np.allclose(change / 1e-5, first.slope[..., index], atol=1e-4, rtol=1e-3)


def test_trims_of_flights_are_separated_from_scatter_and_weighed_moments_are_independent_units():
    weights = weights_of(made(np.random.default_rng(1), count=60))
    assert weights.scatter == pytest.approx([0.3, 0.3, 0.3], rel=0.05)
    assert weights.trim == pytest.approx([0.5, 0.0, 2.0], abs=0.35)
    assert np.isinf(weights_of(made(np.random.default_rng(1), count=2)).trim).all()
    # A single flight is validated by thirds, others by flights.
    assert validation_groups(np.array([2, 2, 5])).tolist() == [2, 2, 5]
    assert validation_groups(np.zeros(6)).tolist() == [0, 0, 1, 1, 2, 2]
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


def test_errors_of_a_reconstructed_pose_are_whitened_with_the_trim():
    """The noise that remains is independent and of unit size, by its exact covariance."""
    count, unit, trim = 40, 0.2, np.array([1.0, 0.5, 2.0])
    pose_slope = 0.5 + 0.15 * np.random.default_rng(0).standard_normal((count, 3, 2))
    flat = pose_slope.reshape(3 * count, 2)
    covariance = np.kron(np.ones((count, count)), np.diag(trim**2)) + flat @ flat.T
    covariance += unit**2 * np.eye(3 * count)
    # Whitening is linear: slopes that are the columns of the identity give its matrix.
    columns = np.eye(3 * count).reshape(count, 3, 3 * count)
    none, flight = np.zeros((count, 3)), np.zeros(count, int)
    data = ViewData(flight, 0.1 * np.arange(count), none, none, columns, pose_slope)
    matrix = whitened(data, Weights(np.full(3, unit), np.ones(3), trim))[1].reshape(3 * count, -1)
    np.testing.assert_allclose(matrix @ covariance @ matrix.T, np.eye(3 * count), atol=1e-9)


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
    assert any("constant_wind velocity" in line for line in implausible(SPACE, start, whole))
    drag = [i for i, entry in enumerate(SPACE.entries) if entry.effect == "linear_drag"]
    assert not at_bound(SPACE, theta, Candidate("linear_drag", tuple(drag), "linear_drag"))


ROWS, STEP_S = 1200, 0.05


def data_of(residual, slope):
    """Return two flights of half a minute; `slope` (M, 3) is that along the only parameter."""
    flight = np.repeat([0, 1], ROWS // 2)
    middle_s = np.tile(STEP_S * np.arange(ROWS // 2), 2)
    none = np.zeros((len(flight), 3, 0))
    return ViewData(flight, middle_s, slope, residual, slope[..., None], none)


def fitted(slow, *, closed_loop, seed=0) -> tuple[ViewData, np.ndarray]:
    """Return the fit of a thrust scale under motors that answer a slow force, or less thrust."""
    rng = np.random.default_rng(seed)
    slow = slow * gaussian_filter1d(rng.standard_normal((ROWS, 3)), 20.0, axis=0) * 8.0
    fast, noise = rng.standard_normal((2, ROWS, 3))
    motors = fast - slow if closed_loop else fast + slow
    measured = motors + slow if closed_loop else 0.6 * motors
    lacks = measured + 0.1 * noise - motors
    away = float((lacks * motors).sum() / (motors**2).sum())
    return data_of(lacks - away * motors, motors), np.array([away])


@pytest.mark.parametrize("slow", [1.0, 3.0])
def test_a_slow_force_that_motors_answer_is_no_weak_thrust(slow):
    found, away = fitted(slow, closed_loop=True)
    assert away[0] < -0.3, "it does look like less thrust"
    share, half_width = fast_share(found, [0], away, THRESHOLDS)
    assert share + half_width < 0.3
    assert not fast_changes_agree(found, [0], away, THRESHOLDS)


def test_less_thrust_is_so_for_slow_and_fast_changes():
    found, away = fitted(1.0, closed_loop=False)
    assert away[0] == pytest.approx(-0.4, abs=0.02)
    share, half_width = fast_share(found, [0], away, THRESHOLDS)
    assert share == pytest.approx(1.0, abs=3.0 * half_width) and half_width < 0.1
    assert fast_changes_agree(found, [0], away, THRESHOLDS)


def test_changes_reach_across_no_hole_and_no_two_flights():
    data = data_of(np.cumsum(np.ones((ROWS, 3)), axis=0), np.ones((ROWS, 3)))
    kept = np.ones(ROWS, bool)
    kept[100:110] = False
    found = successive_changes(ViewData(*(field[kept] for field in data)))
    assert len(found.flight) == ROWS - 10 - 1 - 2
    np.testing.assert_array_equal(found.residual, 1.0)
    np.testing.assert_array_equal(found.slope, 0.0)
    # Means of flights have no changes, which contradicts nothing.
    fit, away = fitted(1.0, closed_loop=True)
    means = ViewData(*(field[[0, -1]] for field in fit))
    assert fast_changes_agree(means, [0], away, THRESHOLDS)

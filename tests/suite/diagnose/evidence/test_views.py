"""The evidence of views: slopes, weights of flights with a trim each, and what has changed."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from suite.diagnose.data.flights import ready
from suite.diagnose.data.view import FORCE, TORQUE
from suite.diagnose.estimate import parameters
from suite.diagnose.estimate.composites import composites
from suite.diagnose.estimate.permutation import corrected_p_values
from suite.diagnose.evidence import view_means
from suite.diagnose.evidence.evidence import validation_groups
from suite.diagnose.evidence.views import ViewEvidence, view_candidates
from suite.diagnose.search import change
from suite.diagnose.search.search import search
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from tests.support.real_flights import VEHICLE, flights

SPACE = parameters.make_space(VEHICLE)
CANDIDATES = parameters.candidates(SPACE, False, ())


def places(effect):
    return tuple(i for i, entry in enumerate(SPACE.entries) if entry.effect == effect)


def data_of(residual, slope, count=2, value=None):
    """Return `count` flights with means of 50 ms; `slope` (M, 3) is that along one parameter."""
    length = len(residual) // count
    flight, middle_s = np.repeat(np.arange(count), length), np.tile(0.05 * np.arange(length), count)
    slope, none = slope.reshape(len(flight), 3, -1), np.zeros((len(flight), 3, 0))
    value = residual if value is None else value
    return view_means.ViewData(flight, middle_s, value, residual, slope, none)


def made(rng, count, length=200, trim=(0.5, 0.0, 2.0), scatter=0.3):
    means = np.repeat(rng.standard_normal((count, 3)) * trim, length, axis=0)
    residual = scatter * rng.standard_normal((count * length, 3)) + means
    return data_of(residual, np.ones_like(residual), count)


def test_slopes_are_those_of_finite_differences():
    model, theta = view_means.ForceModel(VEHICLE, False), SPACE.array("start")
    smoothed = ready(flights(1, duration_s=2.0), VEHICLE).smoothed[FORCE.name]
    evidence = ViewEvidence(FORCE, model, smoothed)
    first = evidence.residuals(theta, None)
    for index in (0, 10, 25):
        moved = theta.copy()
        moved[index] += 1e-5
        change = evidence.residuals(moved).value - first.value
        assert np.allclose(change / 1e-5, first.slope[..., index], atol=1e-4, rtol=1e-3)


def test_trims_of_flights_are_separated_from_scatter_and_weighted_means_are_independent_units():
    weights = view_means.weights_of(made(np.random.default_rng(1), count=60))
    assert weights.scatter == pytest.approx([0.3, 0.3, 0.3], rel=0.05)
    assert weights.trim == pytest.approx([0.5, 0.0, 2.0], abs=0.35)
    assert np.isinf(view_means.weights_of(made(np.random.default_rng(1), count=2)).trim).all()
    # A single flight is validated by thirds, others by flights.
    assert validation_groups(np.array([2, 2, 5])).tolist() == [2, 2, 5]
    assert validation_groups(np.zeros(6)).tolist() == [0, 0, 1, 1, 2, 2]
    rng = np.random.default_rng(2)
    weights = view_means.Weights(np.full(3, 0.3), np.ones(3), np.array([0.5, 0.0, 2.0]))
    drawn = np.array([view_means.whitened(made(rng, 1, 50), weights)[0] for _ in range(200)])
    means, within = drawn.sum(axis=1) / np.sqrt(50), drawn.std(axis=1)
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
    data = view_means.ViewData(flight, 0.1 * np.arange(count), none, none, columns, pose_slope)
    matrix = view_means.whitened(data, view_means.Weights(np.full(3, unit), np.ones(3), trim))[
        1
    ].reshape(3 * count, -1)
    np.testing.assert_allclose(matrix @ covariance @ matrix.T, np.eye(3 * count), atol=1e-9)


def test_sizes_beyond_three_times_the_usual_are_implausible():
    at = places("frame_tilt")
    tilt = parameters.Candidate("frame_tilt", at, "frame_tilt")
    drag = parameters.Candidate("linear_drag", places("linear_drag"), "linear_drag")
    wind = next(one for one in composites(CANDIDATES) if "wind" in one.name)
    begin, theta, blown = (SPACE.array("start") for _ in range(3))
    assert parameters.implausible(SPACE, begin, tilt) == []
    theta[at[0]] = 1.1 * THRESHOLDS.implausible_times * 0.035
    assert len(parameters.implausible(SPACE, theta, tilt)) == 1
    assert not parameters.at_bound(SPACE, theta, tilt)
    theta[at[0]] = SPACE.array("high")[at[0]]
    assert parameters.at_bound(SPACE, theta, tilt) and not parameters.at_bound(SPACE, theta, drag)
    pairs = ((begin, tilt), (begin, wind), (theta, tilt))
    order = [parameters.usual_first(SPACE, *pair) for pair in pairs]
    assert order[0] < order[1] < order[2]
    blown[list(wind.indices)] = 20.0
    lines = parameters.implausible(SPACE, blown, wind)
    assert any("constant_wind velocity" in line for line in lines)


ROWS = 1200


def fitted(slow, *, closed_loop, seed=0) -> tuple[view_means.ViewData, np.ndarray]:
    """Return the fit of a thrust scale under motors that answer a slow force, or less thrust."""
    rng = np.random.default_rng(seed)
    slow = slow * gaussian_filter1d(rng.standard_normal((ROWS, 3)), 20.0, axis=0) * 8.0
    fast, noise = rng.standard_normal((2, ROWS, 3))
    motors = fast - slow if closed_loop else fast + slow
    measured = motors + slow if closed_loop else 0.6 * motors
    lacks = measured + 0.1 * noise - motors
    away = float((lacks * motors).sum() / (motors**2).sum())
    return data_of(lacks - away * motors, motors, value=motors), np.array([away])


@pytest.mark.parametrize(("slow", "closed_loop"), [(1.0, True), (3.0, True), (1.0, False)], ids=str)
def test_a_slow_force_that_motors_answer_is_no_weak_thrust_but_less_thrust_is(slow, closed_loop):
    found, away = fitted(slow, closed_loop=closed_loop)
    share, half_width = fast_share = view_means.fast_share(found, [0], away, THRESHOLDS)
    if closed_loop:
        assert away[0] < -0.3, "it does look like less thrust"
        assert sum(fast_share) < 0.3
    else:
        assert away[0] == pytest.approx(-0.4, abs=0.02)
        assert share == pytest.approx(1.0, abs=3.0 * half_width) and half_width < 0.1
    assert view_means.fast_changes_agree(found, [0], away, THRESHOLDS) != closed_loop


def test_changes_reach_across_no_hole_and_no_two_flights():
    ones = np.ones((ROWS, 3))
    data = data_of(np.cumsum(ones, axis=0), ones)
    kept = np.ones(ROWS, bool)
    kept[100:110] = False
    found = view_means.successive_changes(view_means.ViewData(*(field[kept] for field in data)))
    assert len(found.flight) == ROWS - 10 - 1 - 2
    np.testing.assert_array_equal(found.residual, 1.0)
    np.testing.assert_array_equal(found.slope, 0.0)
    # Means of flights have no changes, which contradicts nothing.
    fit, away = fitted(1.0, closed_loop=True)
    means = view_means.ViewData(*(field[[0, -1]] for field in fit))
    assert view_means.fast_changes_agree(means, [0], away, THRESHOLDS)


DRAG = (0.4, 0.3, 0.2)


def task_of(logs, view=FORCE):
    smoothed = ready(logs, VEHICLE).smoothed[view.name]
    return ViewEvidence(view, view_means.ForceModel(VEHICLE, False), smoothed)


def named(found):
    return [name.candidate.label for name in found.named]


@pytest.fixture(scope="module")
def before():
    """Return reference flights, by view, of a vehicle that the file describes wrongly."""
    logs = flights(3, 5, 4.0, 1.0, thrust_scale=(0.9,), linear_drag=(DRAG,))
    return {view.name: task_of(logs, view) for view in (FORCE, TORQUE)}


@pytest.mark.extended
@pytest.mark.parametrize("share", [0.8, pytest.param(1.0, marks=pytest.mark.slow)])
def test_a_change_stands_out_of_how_flights_differ_though_the_file_is_wrong(before, share):
    motor = {"weak_motor": ((1.0, 1.0, share, 1.0),)} if share < 1.0 else {}
    logs = flights(3, 6, 4.0, 1.0, thrust_scale=(0.9,), linear_drag=(DRAG,), **motor)
    after = {view.name: task_of(logs, view) for view in (FORCE, TORQUE)}
    spread = change.rotor_spread([*before.values(), *after.values()])
    found = {}
    for name, task in after.items():
        begin = change.change_evidence(before[name], task.flights, spread)
        among = view_candidates(CANDIDATES, begin.block)
        found[name] = named(search(begin, among))
        if share < 1.0:
            # Only what comes near the best may stand in its place: otherwise a more usual effect
            # replaces the right one.
            scores = begin.evidence.scores(begin, [], among, 0)
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
    along = {view: list(one) for view, one in spread.freedom_along.items()}
    assert along == {"force": [0, 0, own], "torque": [own] * 3}
    quiet = spread.share * np.sqrt(prior / (prior + own))
    assert quiet <= spread.along["force"][2] < 1.05 * quiet
    assert (spread.along["torque"] > spread.share).all()


def test_sizes_are_drawn_as_the_spread_is_estimated():
    along = {"force": np.array([0, 0, 2]), "torque": np.full(3, 2)}
    spread = change.RotorSpread(0.01, 8, {}, along)
    limits = Thresholds(change_draws=20_000)
    sizes = {view: spread.variance_ratios(view, limits, np.random.default_rng(1)) for view in along}
    assert sizes["force"].mean(axis=0) == pytest.approx(np.ones(3), rel=0.02)
    # Axes without an estimate have the spread of all: a chi-square of 8 degrees over 8.
    assert sizes["force"][:, 0].var() == pytest.approx(2.0 / 8.0, rel=0.05)
    own, shared = 2.0 * 2.0, 2.0 * 8.0  # variances of the sums of squares
    both = (4.0 / 8.0) ** 2 * shared + own + 2.0 * (4.0 / 8.0) * own
    assert sizes["torque"].var(axis=0) == pytest.approx(np.full(3, both / 36.0), rel=0.05)


@pytest.mark.extended
def test_more_drag_is_named_with_its_whole_size_and_other_speeds_are_no_change(monkeypatch):
    p_values, welch = list[float](), change.ttest_ind

    def spy(*fits, **options):
        result = welch(*fits, **options)
        p_values.extend(result.pvalue)
        return result

    monkeypatch.setattr(change, "ttest_ind", spy)
    more, dragged = (0.6, 0.5, 0.2), task_of(flights(3, 5, 4.0, linear_drag=(DRAG,)))
    after = task_of(flights(3, 6, 4.0, 2.5, linear_drag=(more,)))
    found = change.search_motion_change(dragged, after, CANDIDATES, 2)
    assert found is not None and named(found) == ["linear_drag"]
    # Bonferroni: the least p-value, which is the drag's, times the number of all of them, for
    # two views.
    assert found.named[0].p_value == pytest.approx(2 * len(p_values) * min(p_values))
    np.testing.assert_allclose(found.estimate.theta[found.indices], more, atol=0.06)
    np.testing.assert_allclose(found.start.theta[found.indices], DRAG, atol=0.06)
    after = task_of(flights(3, 7, 4.0, 2.0, linear_drag=(DRAG,)))
    assert change.search_motion_change(dragged, after, CANDIDATES, 2) is None


def test_the_fit_of_each_flight_ignores_its_trim():
    rng = np.random.default_rng(0)
    flight, slope = np.repeat([0, 1], 200), rng.standard_normal((400, 3, 2))
    true, trim = np.array([[0.5, -1.0], [0.7, 0.0]]), np.array([3.0, -2.0])
    residual = np.einsum("mak,mk->ma", slope, true[flight]) + trim[flight, None]
    equations = change.equations_by_flight(
        change.within_flights(data_of(residual, slope)), np.ones(3)
    )
    np.testing.assert_allclose(change.fit_each_flight(equations), true, atol=1e-9)


FREEDOM = 12
SIZES = np.random.default_rng(0).chisquare(FREEDOM, (299, 3)) / FREEDOM


def searched(slope, groups, truth=0.0, fitted=(), seed=0):
    """Return p-values and gains of `groups` for noise and `truth` times column 0."""
    rng = np.random.default_rng(seed)
    size = np.sqrt(rng.chisquare(FREEDOM, 3) / FREEDOM)
    left = (rng.standard_normal(slope.shape[:2]) / size + truth * slope[..., 0]).ravel()

    def fall(columns):
        if not columns:
            return 0.0
        rows = slope.reshape(-1, slope.shape[-1])[:, list(columns)]
        return float(left @ rows @ np.linalg.pinv(rows) @ left)

    without = fall(fitted)
    gains = [fall([*fitted, *group]) - without for group in groups]
    return corrected_p_values(gains, slope, groups, fitted, SIZES, np.random.default_rng(1)), gains


def names_by_chance(slope, groups, **asked):
    return np.mean([min(searched(slope, groups, seed=k, **asked)[0]) <= 0.1 for k in range(100)])


def test_chance_names_as_often_as_it_is_allowed_however_alike_candidates_are():
    rng = np.random.default_rng(5)
    common = rng.standard_normal((6, 3, 1))
    slope = 0.99 * common + 0.01 * rng.standard_normal((6, 3, 10))
    assert names_by_chance(slope, [(k,) for k in range(10)]) == pytest.approx(0.1, abs=0.055)
    several = [(0,), (1, 2, 3), (4, 5), (6,)]
    assert names_by_chance(slope, several, fitted=(9,)) == pytest.approx(0.1, abs=0.055)


def test_candidates_that_are_one_or_fitted_anyhow_cost_as_much_as_one_and_others_more():
    slope = np.random.default_rng(6).standard_normal((6, 3, 10))
    one, gains = searched(slope, [(0,)], truth=0.8)
    ten = [(k,) for k in range(10)]
    twins, _ = searched(np.repeat(slope[..., :1], 10, axis=-1), ten, truth=0.8)
    others, others_gains = searched(slope, ten, truth=0.8)
    assert others_gains[0] == pytest.approx(gains[0])
    assert twins == pytest.approx(one * 10)
    assert 3.0 * one[0] < others[0] < 15.0 * one[0]
    slope = np.random.default_rng(8).standard_normal((6, 3, 3)) * [1e6, 1.0, 1e-6]
    slope[..., 2] = 0.3 * slope[..., 0]

    def p_values(gains, groups):
        return corrected_p_values(gains, slope, groups, (0,), SIZES, np.random.default_rng(1))

    same, apart = p_values([1.0, 1.0], [(2,), (1,)])
    assert same == apart == p_values([1.0], [(1,)])[0]


def test_what_all_flights_are_judged_from_is_off_for_all_alike():
    rng, few, many = np.random.default_rng(7), 2, 8
    one, few_share = np.ones(3), np.full(3, 1.0 / np.sqrt(few))
    weights = view_means.Weights(np.full(3, 1e-3), one, one, few_share)
    unknown = weights._replace(trim=np.array([1.0, np.inf, 1.0]))
    sums = {"with it": [], "without": []}
    for _ in range(500):
        residual = rng.standard_normal((many, 3)) - rng.standard_normal((few, 3)).mean(axis=0)
        data = data_of(residual, np.ones((many, 3)), many)
        for key, given in (("with it", weights), ("without", weights._replace(base=None))):
            white, slope = view_means.whitened(data, given)
            sums[key].append((white * slope[..., 0]).sum(axis=0) / np.sqrt((slope**2).sum((0, 2))))
    assert np.all(view_means.whitened(data, unknown)[0][:, 1] == 0.0)
    assert np.std(sums["with it"], axis=0) == pytest.approx(np.ones(3), rel=0.06)
    assert np.std(sums["without"], axis=0).min() > 2.0  # the square root of 1 + 8 / 2

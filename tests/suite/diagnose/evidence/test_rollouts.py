"""The model of rollouts against fine integration: its slopes, its noise and colour, its hooks."""

from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest

from eval.flights.simulate import SENSORS, fly, log_of
from suite.diagnose.data.noise import (
    INTEGRATED,
    Linearisation,
    Noise,
    colour_filter,
    measured_noise,
    residual_as_noise,
)
from suite.diagnose.data.whitening import block_of, make_whitening, orthonormal, slow_energy
from suite.diagnose.data.windows import KNOTS, SLICES, STATE, cut
from suite.diagnose.estimate.parameters import candidates, make_space
from suite.diagnose.evidence import rollouts
from suite.diagnose.evidence.linearise import arrays_of
from suite.diagnose.thresholds import THRESHOLDS
from tests.support.broken_logs import rows
from tests.support.continuous_flights import fly_finely
from tests.support.diagnosis_flights import NOISE, fly_all
from tests.support.faults import with_imu_fault
from tests.support.vehicles import PLAIN, with_effects, with_lag
from tests.support.ways import EIGHT

DRAG = (0.3, 0.35, 0.1)
flown = cache(lambda layout: jax.jit(rollouts.compiled(layout, False, False, "continuous")[0]))


@pytest.mark.extended
@pytest.mark.usefixtures("compiled_quickly")
@pytest.mark.parametrize(
    ("frequency", "rate_hz", "lag", "delay"),
    [
        (500.0, 50.0, 0.03, 0.0273),
        # A delay of part of a step, which no lag smooths.
        (500.0, 100.0, 0.0, 0.0013),
        pytest.param(1000.0, 100.0, 0.015, 0.0, marks=pytest.mark.slow),
        pytest.param(2000.0, 100.0, 0.0, 0.01, marks=pytest.mark.slow),
        pytest.param(200.0, 100.0, 0.03, 0.0273, marks=pytest.mark.slow),
        pytest.param(500.0, 500.0, 0.03, 0.005, marks=pytest.mark.slow),
        pytest.param(1000.0, 1000.0, 0.03, 0.005, marks=pytest.mark.slow),
    ],
)
def test_a_second_of_flight_is_met_within_a_tenth_of_the_noise(frequency, rate_hz, lag, delay):
    vehicle = replace(PLAIN, controller=replace(PLAIN.controller, frequency=frequency))
    log = fly_finely(vehicle, 1, 2.5, rate_hz, 0.3, 3.0, lag, delay, DRAG, 1e-3)
    late = {"command_delay": (delay,)} if delay else {}
    truth = with_effects(vehicle, linear_drag=(DRAG,), motor_lag=(lag,), **late)
    windows, _ = cut([log], truth, False)
    assert windows is not None and len(windows.flight) == 2
    space, start = make_space(truth), np.zeros((len(windows.flight), STATE + 4))
    with jax.enable_x64(True):
        off, _ = flown(space.layout)(arrays_of(truth, space), space.array("start"), start, windows)
    for name in ("position", "attitude", "velocity", "rates", "accelerometer"):
        error = float(np.sqrt((np.asarray(off)[..., SLICES[name]] ** 2).mean()))
        short = "rate" if name == "rates" else name[:3]
        assert error < 0.1 * NOISE[short], name


def test_rollouts_begin_at_the_file_and_the_measured_states_of_the_windows(log):
    def along(*logs, **options):
        return rollouts.rollouts_along(logs, PLAIN, True, **options)

    model, windows, start = along(log, stride_s=0.5)
    assert len(windows.flight) > len(along(log)[1].flight) > 0
    assert np.array_equal(start.theta, make_space(PLAIN).array("start"))
    assert start.free.shape == (len(windows.flight), STATE + 4 * KNOTS) and not start.free.any()
    assert len(model.starts) == start.free.shape[1]
    with pytest.raises(ValueError, match=r"no stretch of 1\.\d+ s in flight without a hole"):
        along(rows(log, log.time_s < 0.5))


@pytest.fixture(scope="module")
def linearised(flown):
    """Return the model of the shared diagnosis, its windows, and their slopes along everything."""
    model, (windows, _) = flown.model, cut(flown.logs, flown.vehicle, False)
    assert windows is not None
    begin = rollouts.start_estimate(model, windows)
    return model, windows, model.linearise(begin, windows)


def test_slopes_are_those_of_small_changes_and_a_disturbance_pushes_the_windows(linearised):
    model, windows, linear = linearised
    begin = rollouts.start_estimate(model, windows)
    index = model.space.layout.index(("linear_drag", "coefficient", 0))
    step = 1e-4 * (np.arange(model.size) == index)
    moved = (begin._replace(theta=begin.theta + sign * step) for sign in (-1, 1))
    ends = [model.residual(at, windows) for at in moved]
    slope = (ends[0] - ends[1]) / 2e-4
    np.testing.assert_allclose(linear.slope[..., index], slope, atol=1e-4)
    few = model.linearise(begin, windows, [index])
    np.testing.assert_allclose(few.slope[..., 0], linear.slope[..., index], atol=1e-9)
    response, knot = model.respond(begin, windows)
    assert response.slope.shape[-1] == KNOTS * 6
    assert knot.rotor_speed.shape == (len(windows.flight), KNOTS, 4)
    up = response.slope[..., 2::6].sum(axis=-1)[:, :, 2]
    at = np.abs(np.asarray(windows.row_s) - 0.5).argmin(axis=1)
    # 1 m/s^2 along body z for half a second, less what tilt takes of it.
    np.testing.assert_allclose(up[np.arange(len(at)), at], 0.125, rtol=0.5)


def test_what_the_start_explains_is_projected_out(linearised):
    model, windows, linear = linearised
    sigma = np.where(windows.valid.any(axis=(0, 1)), 0.01, np.nan)
    whitening = make_whitening(linear, Noise(sigma, {}), THRESHOLDS)
    moved = np.random.default_rng(0).standard_normal((len(windows.flight), STATE))
    by_start = np.einsum("wnck,wk->wnc", linear.slope[..., model.starts[:STATE]], moved)
    start_only = linear._replace(residual=by_start, offset=0.0 * linear.offset)
    block = block_of(whitening, start_only, range(3))
    assert np.abs(block.residual).max() < 1e-6 * np.abs(by_start * whitening.weight).max()
    np.testing.assert_allclose(block.free[:, :STATE], moved, atol=1e-6)
    assert (whitening.slow_freedom >= -1e-9).all()

    def energy(seed):
        noise = np.random.default_rng(seed).standard_normal(linear.residual.shape)
        white = linear._replace(residual=np.nan_to_num(sigma) * noise)
        return slow_energy(whitening, block_of(whitening, white, ()).residual).sum()

    # Noise alone gives one for each degree of freedom that the start leaves.
    mean = np.mean([energy(seed) for seed in range(10)])
    assert mean == pytest.approx(whitening.slow_freedom.sum(), rel=0.05)


def test_columns_that_depend_on_each_other_are_made_orthonormal_too():
    matrix = np.random.default_rng(0).standard_normal((3, 40, 4))
    for tall in (matrix, matrix[..., [0, 1, 2, 2]] + 1e-9 * matrix):
        base, upper = orthonormal(tall, 1e-5)
        np.testing.assert_allclose(base @ upper, tall, atol=1e-9)
        unit = np.broadcast_to(np.eye(4), (3, 4, 4))
        np.testing.assert_allclose(np.swapaxes(base, 1, 2) @ base, unit, atol=1e-6)


def test_windows_are_trusted_until_the_model_leaves_the_flight(linearised):
    _, windows, linear = linearised
    residual = np.zeros_like(linear.residual)
    residual[0, np.asarray(windows.row_s)[0] > 0.4, 0] = 1.0
    view = rollouts.trusted(windows, residual, THRESHOLDS)
    last = [np.asarray(windows.row_s)[w][view.valid[w].any(axis=1)].max() for w in (0, 1)]
    assert last == pytest.approx([0.25, 1.0], abs=0.011)


GROUP = "attitude"


@pytest.fixture(scope="module")
def windows():
    found, _ = cut(fly_all([PLAIN] * 8, range(8), duration_s=2.5), PLAIN, False)
    return found


def linear_of(residual, windows):
    """Return residuals that do not depend on the start."""
    slope = np.zeros((*residual.shape, 12))
    return Linearisation(residual, slope, np.zeros((len(residual), 12)), windows)


def measured(residual, windows):
    """Return the noise of residuals that do not depend on the start."""
    return measured_noise(linear_of(residual, windows))


def noise_like(windows, share, lasts_s, rng, group=GROUP):
    """Return white noise of 1 in every channel, that of `group` with a Gauss-Markov part."""
    values = rng.standard_normal(windows.valid.shape)
    shape = values[..., SLICES[group]].shape
    slow = np.zeros(shape)
    slow[:, 0] = rng.standard_normal((shape[0], 3))
    keeps = np.exp(-np.diff(windows.row_s, axis=1) / lasts_s)[..., None]
    for row in range(1, shape[1]):
        fresh = np.sqrt(1.0 - keeps[:, row - 1] ** 2) * rng.standard_normal((shape[0], 3))
        slow[:, row] = keeps[:, row - 1] * slow[:, row - 1] + fresh
    mixed = np.sqrt(1.0 - share) * values[..., SLICES[group]] + np.sqrt(share) * slow
    values[..., SLICES[group]] = mixed
    return np.where(windows.valid, values, 0.0)


@pytest.mark.parametrize(
    ("group", "share", "lasts_s"),
    [("velocity", 0.85, 0.02), ("attitude", 0.7, 0.06), ("position", 0.3, 0.05)],
)
def test_a_colour_is_found_where_it_is(windows, group, share, lasts_s):
    values = noise_like(windows, share, lasts_s, np.random.default_rng(0), group)
    noise = measured(values, windows)
    assert group in noise.coloured
    found_share, found_s = noise.coloured[group]
    # What counts is how much of it there is at frequencies of a second.
    assert 0.6 < (found_share * found_s) / (share * lasts_s) < 1.6
    for name, (other_share, _) in noise.coloured.items():
        assert name == group or other_share < 0.1
    np.testing.assert_allclose(noise.sigma[SLICES[group]], 1.0, rtol=0.3)
    np.testing.assert_allclose(noise.sigma[SLICES["rates"]], 1.0, rtol=0.1)


def test_flights_without_noise_beside_noisy_ones_leave_it_finite(windows):
    values = noise_like(windows, 0.85, 0.02, np.random.default_rng(0), "velocity")
    values[5:] = np.asarray(windows.row_s)[5:, :, None]  # rounding leaves a negative energy
    noise = measured(values, windows)
    assert noise.coloured and np.isfinite(noise.sigma[:12]).all()


def test_groups_of_one_estimator_have_one_correlation_time(windows):
    rng = np.random.default_rng(3)
    weak = noise_like(windows, 0.02, 0.05, rng, "velocity")
    pose = SLICES["position"]
    weak[..., pose] = noise_like(windows, 0.9, 0.05, rng, "position")[..., pose]
    coloured = measured(weak, windows).coloured
    assert set(coloured) == set(INTEGRATED)
    assert coloured["velocity"][1] == coloured["position"][1] == pytest.approx(0.05, rel=0.4)
    assert coloured["velocity"][0] < 0.1


def test_white_noise_and_a_slow_error_of_the_model_have_no_colour(windows):
    residual = noise_like(windows, 0.0, 1.0, np.random.default_rng(1))
    assert measured(residual, windows).coloured == {}
    bent = residual + 5.0 * (windows.row_s**2)[..., None] * windows.valid
    assert measured(bent, windows).coloured == {}


def test_the_filter_makes_rows_independent(windows):
    noise = Noise(np.ones(19), {GROUP: (0.85, 0.05)})
    one = colour_filter(noise, GROUP, windows)
    values = noise_like(windows, 0.85, 0.05, np.random.default_rng(2))[..., SLICES[GROUP]]
    white = one @ values
    neighbours = (white[:, 1:] * white[:, :-1]).mean() / (white**2).mean()
    assert abs(neighbours) < 0.03 < (values[:, 1:] * values[:, :-1]).mean()
    assert abs((white**2).mean() - 1.0) < 0.05


def test_where_the_model_lacks_something_the_whole_residual_counts_as_noise(windows):
    rng = np.random.default_rng(5)
    residual = noise_like(windows, 0.0, 1.0, rng)
    swing = np.sin(6.0 * windows.row_s[..., None] + rng.uniform(0.0, 6.0, (len(residual), 1, 3)))
    residual[..., SLICES["velocity"]] += 8.0 * swing
    noise = residual_as_noise(linear_of(residual, windows))
    np.testing.assert_allclose(noise.sigma[SLICES["velocity"]], 8.0 / np.sqrt(2.0), rtol=0.3)
    share, lasts_s = noise.coloured["velocity"]
    assert share > 0.95 and lasts_s > 0.1
    np.testing.assert_allclose(noise.sigma[SLICES["position"]], 1.0, rtol=0.1)


GIVEN = with_lag(PLAIN, 0.02)
TURN = (0.01, -0.015, 0.02)


@pytest.mark.extended
def test_a_fault_from_a_package_is_a_candidate_and_in_the_simulated_log(
    monkeypatch, compiled_quickly
):
    """Residuals of a flight without noise nearly vanish where the model has the true fault."""
    with_imu_fault(monkeypatch)
    truth = with_effects(GIVEN, imu_fault=(TURN, 1.04, 0.01))
    (flight,) = fly(GIVEN, truth, [EIGHT], SENSORS["estimator"].rate_hz)
    log = log_of(flight, truth, SENSORS["estimator"], None, "flight")
    windows, _ = cut([log], GIVEN, False, integrator="euler")
    space = make_space(GIVEN)
    (one,) = [c for c in candidates(space, False, set()) if c.name == "imu_fault"]
    assert len(one.indices) == 5
    model, start = rollouts.RolloutModel(GIVEN, False, False, "euler"), space.array("start")
    true = start.copy()
    true[list(one.indices)] = *TURN, 1.04, 0.01
    fly_model = jax.jit(rollouts.compiled(space.layout, False, False, "euler")[0])
    with jax.enable_x64(True):
        starts = [rollouts.start_estimate(model, windows, theta) for theta in (start, true)]
        off = [np.asarray(fly_model(model.given, *both, windows)[0]) for both in starts]
    for channel in ("position", "attitude", "velocity", "rates"):
        before, after = (np.sqrt((o[..., SLICES[channel]] ** 2).mean()) for o in off)
        assert after < (0.05 if channel == "attitude" else 0.1) * before, channel

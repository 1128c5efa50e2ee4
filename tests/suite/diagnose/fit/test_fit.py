"""The model of rollouts that is fitted: its slopes, its whitening, and how long it is trusted."""

import numpy as np
import pytest

from suite.diagnose.data.colour import Noise
from suite.diagnose.data.whitening import block_of, make_whitening, orthonormal, slow_energy
from suite.diagnose.data.windows import KNOTS, STATE
from suite.diagnose.evidence.rollouts import start_estimate, trusted


@pytest.fixture(scope="module")
def linearised(flown):
    """Return the model of the shared diagnosis, its windows, and their slopes along everything."""
    model, windows = flown.model, flown.cut(1.0)
    begin = start_estimate(model, windows)
    return model, windows, model.linearise(begin.theta, begin.free, windows, None)


def test_slopes_are_those_of_small_changes_and_a_disturbance_pushes_the_windows(linearised):
    model, windows, linear = linearised
    begin = start_estimate(model, windows)
    index = model.space.layout.index(("linear_drag", "coefficient", 0))
    step = np.zeros(model.size)
    step[index] = 1e-4
    ends = [model.residual(begin.theta + s * step, begin.free, windows) for s in (-1, 1)]
    slope = (ends[0] - ends[1]) / 2e-4
    np.testing.assert_allclose(linear.slope[..., index], slope, atol=1e-4)
    few = model.linearise(begin.theta, begin.free, windows, [index])
    np.testing.assert_allclose(few.slope[..., 0], linear.slope[..., index], atol=1e-9)
    response = model.respond(begin.theta, begin.free, windows)
    assert response.slope.shape[-1] == KNOTS * 6
    assert response.knot.rotor_speed.shape == (len(windows.flight), KNOTS, 4)
    up = response.slope[..., 2::6].sum(axis=-1)[:, :, 2]
    at = np.abs(np.asarray(windows.row_s) - 0.5).argmin(axis=1)
    # 1 m/s^2 along body z for half a second, less what tilt takes of it.
    np.testing.assert_allclose(up[np.arange(len(at)), at], 0.125, rtol=0.5)


def test_what_the_start_explains_is_projected_out(linearised):
    model, windows, linear = linearised
    sigma = np.where(windows.valid.any(axis=(0, 1)), 0.01, np.nan)
    whitening = make_whitening(linear, Noise(sigma, {}), windows)
    moved = np.random.default_rng(0).standard_normal((len(windows.flight), STATE))
    slope = linear.start_slope
    by_start = np.einsum("wnck,wk->wnc", slope, moved)
    start_only = linear._replace(residual=by_start, offset=0.0 * linear.offset)
    block = block_of(whitening, start_only, range(3), windows)
    assert np.abs(block.residual).max() < 1e-6 * np.abs(by_start * whitening.weight).max()
    np.testing.assert_allclose(block.free[:, :STATE], moved, atol=1e-6)
    assert (whitening.slow_freedom >= -1e-9).all()
    energy = []
    for seed in range(10):
        noise = np.random.default_rng(seed).standard_normal(linear.residual.shape)
        white = linear._replace(residual=np.nan_to_num(sigma) * noise)
        rest = block_of(whitening, white, (), windows).residual
        energy.append(slow_energy(whitening, rest).sum())
    # Noise alone gives one for each degree of freedom that the start leaves.
    assert np.mean(energy) == pytest.approx(whitening.slow_freedom.sum(), rel=0.05)


def test_columns_that_depend_on_each_other_are_made_orthonormal_too():
    rng = np.random.default_rng(0)
    matrix = rng.standard_normal((3, 40, 4))
    for tall in (matrix, matrix[..., [0, 1, 2, 2]] + 1e-9 * matrix):
        base, upper = orthonormal(tall, 1e-5)
        np.testing.assert_allclose(base @ upper, tall, atol=1e-9)
        unit = np.broadcast_to(np.eye(4), (3, 4, 4))
        np.testing.assert_allclose(np.swapaxes(base, 1, 2) @ base, unit, atol=1e-6)


def test_windows_are_trusted_until_the_model_leaves_the_flight(linearised):
    _, windows, linear = linearised
    residual = np.zeros_like(linear.residual)
    residual[0, np.asarray(windows.row_s)[0] > 0.4, 0] = 1.0
    view = trusted(windows, residual)
    last = [np.asarray(windows.row_s)[w][view.valid[w].any(axis=1)].max() for w in (0, 1)]
    assert last == pytest.approx([0.25, 1.0], abs=0.011)

"""The colour of noise: found where it is, not where a model is off, and taken out by its filter."""

import numpy as np
import pytest

from suite.diagnose.data.colour import Noise, colour_filter, measured_noise
from suite.diagnose.data.windows import SLICES, cut
from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN

GROUP = "velocity"


@pytest.fixture(scope="module")
def windows():
    found, _ = cut([fly(PLAIN, seed, duration_s=8.0) for seed in range(3)], PLAIN, False)
    assert found is not None
    return found


def noise_like(windows, share, lasts_s, rng):
    """White noise of 1 in every channel, that of `GROUP` with a Gauss-Markov part."""
    values = rng.standard_normal(windows.seen.shape)
    shape = values[..., SLICES[GROUP]].shape
    slow = np.zeros(shape)
    slow[:, 0] = rng.standard_normal((shape[0], 3))
    keeps = np.exp(-np.diff(windows.row_s, axis=1) / lasts_s)[..., None]
    for row in range(1, shape[1]):
        fresh = np.sqrt(1.0 - keeps[:, row - 1] ** 2) * rng.standard_normal((shape[0], 3))
        slow[:, row] = keeps[:, row - 1] * slow[:, row - 1] + fresh
    mixed = np.sqrt(1.0 - share) * values[..., SLICES[GROUP]] + np.sqrt(share) * slow
    values[..., SLICES[GROUP]] = mixed
    return np.where(windows.seen, values, 0.0)


@pytest.mark.parametrize(("share", "lasts_s"), [(0.85, 0.02), (0.7, 0.06), (0.9, 0.1)])
def test_a_colour_is_found_where_it_is(windows, share, lasts_s):
    noise = measured_noise(noise_like(windows, share, lasts_s, np.random.default_rng(0)), windows)
    assert set(noise.coloured) == {GROUP}
    found_share, found_s = noise.coloured[GROUP]
    # A polynomial is off, so that long memories are known worse than how fast they begin.
    assert 0.6 < (found_share / found_s) / (share / lasts_s) < 1.6
    assert abs(found_share - share) < 0.2
    np.testing.assert_allclose(noise.sigma[SLICES[GROUP]], 1.0, rtol=0.3)
    np.testing.assert_allclose(noise.sigma[SLICES["position"]], 1.0, rtol=0.1)


def test_white_noise_and_a_slow_error_of_the_model_have_none(windows):
    residual = noise_like(windows, 0.0, 1.0, np.random.default_rng(1))
    assert measured_noise(residual, windows).coloured == {}
    bent = residual + 5.0 * (windows.row_s**2)[..., None] * windows.seen
    assert measured_noise(bent, windows).coloured == {}


def test_the_filter_makes_rows_independent(windows):
    noise = Noise(np.ones(19), {GROUP: (0.85, 0.05)})
    one = colour_filter(noise, GROUP, windows)
    values = noise_like(windows, 0.85, 0.05, np.random.default_rng(2))[..., SLICES[GROUP]]
    white = one @ values
    neighbours = (white[:, 1:] * white[:, :-1]).mean() / (white**2).mean()
    assert abs(neighbours) < 0.03 < (values[:, 1:] * values[:, :-1]).mean()
    assert abs((white**2).mean() - 1.0) < 0.05

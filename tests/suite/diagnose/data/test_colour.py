"""The colour of noise: found where it is, not in a model's error, and removed by its filter."""

import numpy as np
import pytest

from suite.diagnose.data.colour import (
    ESTIMATED,
    Noise,
    colour_filter,
    measured_noise,
    residual_as_noise,
)
from suite.diagnose.data.windows import SLICES, cut
from tests.support.diagnosis_flights import fly_all
from tests.support.vehicles import PLAIN

GROUP = "attitude"


@pytest.fixture(scope="module")
def windows():
    found, _ = cut(fly_all([PLAIN] * 3, range(3), duration_s=6.0), PLAIN, False)
    return found


def measured(residual, windows):
    """Return the noise of residuals that do not depend on the start."""
    return measured_noise(residual, np.zeros((*residual.shape, 12)), windows)


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


def test_groups_of_one_estimator_have_one_correlation_time(windows):
    rng = np.random.default_rng(3)
    weak = noise_like(windows, 0.02, 0.05, rng, "velocity")
    pose = SLICES["position"]
    weak[..., pose] = noise_like(windows, 0.9, 0.05, rng, "position")[..., pose]
    coloured = measured(weak, windows).coloured
    assert set(coloured) == set(ESTIMATED)
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
    nothing = np.zeros((*residual.shape, 12))
    noise = residual_as_noise(residual, nothing, windows)
    np.testing.assert_allclose(noise.sigma[SLICES["velocity"]], 8.0 / np.sqrt(2.0), rtol=0.3)
    share, lasts_s = noise.coloured["velocity"]
    assert share > 0.95 and lasts_s > 0.1
    np.testing.assert_allclose(noise.sigma[SLICES["position"]], 1.0, rtol=0.1)

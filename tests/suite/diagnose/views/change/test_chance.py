"""How often chance makes the best of all candidates of a change stand out as much."""

import numpy as np
import pytest

from suite.diagnose.estimate.permutation import corrected_p_values
from suite.diagnose.evidence.moments import ViewData, Weights, whitened

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
    return np.mean([min(searched(slope, groups, seed=k, **asked)[0]) <= 0.1 for k in range(150)])


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
    weights = Weights(np.full(3, 1e-3), np.ones(3), np.ones(3), np.full(3, 1.0 / np.sqrt(few)))
    unknown = weights._replace(trim=np.array([1.0, np.inf, 1.0]))
    sums = {"with it": [], "without": []}
    for _ in range(1000):
        base = rng.standard_normal((few, 3)).mean(axis=0)
        residual = rng.standard_normal((many, 3)) - base
        slope, none = np.ones((many, 3, 1)), np.zeros((many, 3, 0))
        data = ViewData(np.arange(many), np.zeros(many), residual, residual, slope, none)
        for key, given in (("with it", weights), ("without", weights._replace(base=None))):
            white, slope = whitened(data, given)
            sums[key].append((white * slope[..., 0]).sum(axis=0) / np.sqrt((slope**2).sum((0, 2))))
        assert np.all(whitened(data, unknown)[0][:, 1] == 0.0)
    assert np.std(sums["with it"], axis=0) == pytest.approx(np.ones(3), rel=0.06)
    assert np.std(sums["without"], axis=0).min() > 2.0  # the square root of 1 + 8 / 2

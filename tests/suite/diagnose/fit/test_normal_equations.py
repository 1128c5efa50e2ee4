"""The null of the search and the noise estimate, against numbers known beforehand."""

import numpy as np

from suite.diagnose.data.noise import noise_of
from suite.diagnose.data.windows import cut
from suite.diagnose.fit.normal_equations import NormalEquations, solve
from suite.diagnose.fit.parameters import candidates, make_space
from suite.diagnose.fit.permutation import folds_of, score_candidates
from tests.support.diagnosis_flights import NOISE, fly
from tests.support.vehicles import PLAIN


def made_sums(rng, space, true_size, windows=24, rows=40):
    """Windows whose residual is white noise plus `true_size` of the first candidate's slope."""
    slope = rng.standard_normal((windows, rows, len(space.entries)))
    slope /= space.array("step")
    residual = rng.standard_normal((windows, rows))
    residual += true_size * slope[..., 0] * space.array("step")[0]
    turned = np.swapaxes(slope, 1, 2)
    return NormalEquations(
        turned @ slope, (turned @ residual[..., None])[..., 0], (residual**2).sum(1), np.zeros(0)
    )


def test_the_null_gives_small_p_values_as_rarely_as_they_say():
    space = make_space(PLAIN)
    fold = folds_of(np.repeat(np.arange(4), 6), np.tile(np.arange(6.0), 4))
    theta = 0.5 * (space.array("low") + space.array("high"))
    among = candidates(space, False, False)
    rng = np.random.default_rng(3)
    best = [score_candidates(made_sums(rng, space, 0.0), theta, space, [], among, fold)[0].p_value
            for _ in range(60)]  # fmt: skip
    # Of 60 nulls 6 are expected below 0.1; 14 or more come with a chance of 0.2 %.
    assert np.sum(np.array(best) <= 0.1) < 14
    assert np.median(best) > 0.2
    strong = score_candidates(made_sums(rng, space, 0.5), theta, space, [], among, fold)[0]
    assert strong.candidate.name == space.entries[0].effect
    assert strong.p_value <= 0.01


def test_bounds_hold_and_the_free_solution_is_exact():
    square, cross = np.array([[4.0, 1.0], [1.0, 3.0]]), np.array([1.0, -2.0])
    wide, scale = np.full(2, 10.0), np.ones(2)
    np.testing.assert_allclose(
        solve(square, cross, -wide, wide, scale), np.linalg.solve(square, cross), rtol=1e-6
    )
    bound = solve(square, cross, np.array([-10.0, 0.0]), wide, scale)
    np.testing.assert_allclose(bound, [0.25, 0.0], atol=1e-6)


def test_the_noise_is_seen_under_a_models_error():
    log = fly(PLAIN, 0, duration_s=4.0)
    windows, _ = cut([log], PLAIN, False)
    assert windows is not None
    rng = np.random.default_rng(0)
    time = np.asarray(windows.row_s)[..., None]
    residual = 0.3 * time**2 + 0.002 * rng.standard_normal(windows.seen.shape)
    sigma = noise_of(residual, windows)
    np.testing.assert_allclose(sigma[:12], 0.002, rtol=0.15)
    assert np.isnan(sigma[12:]).all()
    assert NOISE["pos"] == 0.002

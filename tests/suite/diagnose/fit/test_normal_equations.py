"""Normal equations and their solution, against parameters known beforehand."""

import numpy as np
import pytest

from suite.diagnose.estimate.block import NormalEquations, products
from suite.diagnose.estimate.gauss_newton import intervals95, solve


def test_bounds_hold_and_the_free_solution_is_exact():
    square, cross = np.array([[4.0, 1.0], [1.0, 3.0]]), np.array([1.0, -2.0])
    wide, scale = np.full(2, 10.0), np.ones(2)
    exact = np.linalg.solve(square, cross)
    np.testing.assert_allclose(solve(square, cross, -wide, wide, scale), exact, rtol=1e-6)
    bound = solve(square, cross, np.array([-10.0, 0.0]), wide, scale)
    np.testing.assert_allclose(bound, [0.25, 0.0], atol=1e-6)
    for hessian, gradient in ((square * np.nan, cross), (square, cross * np.inf)):
        with pytest.raises(ValueError, match="not finite"):
            solve(hessian, gradient, -wide, wide, scale)


def remaining(slope, residual, flight=None):
    """Return the solution, and the normal equations of what it leaves."""
    hessian, gradient = products(slope, residual)
    best = np.linalg.solve(hessian.sum(0), gradient.sum(0))
    return best, NormalEquations(hessian, gradient - hessian @ best, np.zeros(len(slope)), flight)


def test_intervals_hold_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(1)
    inside = []
    for _ in range(100):
        slope = rng.standard_normal((30, 20, 2))
        residual = (slope @ [0.3, -0.2])[..., None] + rng.standard_normal((30, 20, 1))
        best, left = remaining(slope, residual)
        inside.extend(np.abs(best - [0.3, -0.2]) < intervals95(left).half_width)
    # Of 200, 190 are expected inside; fewer than 180 come with a chance of 0.1 %.
    assert sum(inside) >= 180


def test_intervals_by_flights_hold_the_truth_however_many_parameters_are_fitted():
    """An error that comes back in every window of a flight: 4 flights, 3 parameters.

    By the flights' slopes alone 80 % of the intervals hold the truth.
    """
    rng, flight = np.random.default_rng(2), np.repeat(np.arange(4), 5)
    inside = {"by windows": [], "by flights": []}
    for _ in range(400):
        slope = rng.standard_normal((4, 1, 3))[flight] + 0.5 * rng.standard_normal((20, 40, 3))
        residual = rng.standard_normal((20, 40, 1)) + rng.standard_normal((4, 1, 1))[flight]
        best, left = remaining(slope, residual, flight)
        inside["by windows"].append(np.abs(best) <= intervals95(left).half_width)
        inside["by flights"].append(np.abs(best) <= intervals95(left, 1.0).half_width)
    assert np.mean(inside["by windows"]) < 0.7
    assert 0.93 < np.mean(inside["by flights"]) < 0.99

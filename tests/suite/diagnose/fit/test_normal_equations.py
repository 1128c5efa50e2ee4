"""Normal equations and their solution, against numbers known beforehand."""

import numpy as np

from suite.diagnose.estimate.block import NormalEquations, products
from suite.diagnose.estimate.gauss_newton import intervals95, solve


def test_bounds_hold_and_the_free_solution_is_exact():
    square, cross = np.array([[4.0, 1.0], [1.0, 3.0]]), np.array([1.0, -2.0])
    wide, scale = np.full(2, 10.0), np.ones(2)
    np.testing.assert_allclose(
        solve(square, cross, -wide, wide, scale), np.linalg.solve(square, cross), rtol=1e-6
    )
    bound = solve(square, cross, np.array([-10.0, 0.0]), wide, scale)
    np.testing.assert_allclose(bound, [0.25, 0.0], atol=1e-6)


def test_intervals_hold_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(1)
    inside = []
    for _ in range(100):
        slope = rng.standard_normal((30, 20, 2))
        residual = (slope @ [0.3, -0.2])[..., None] + rng.standard_normal((30, 20, 1))
        hessian, gradient = products(slope, residual)
        best = np.linalg.solve(hessian.sum(0), gradient.sum(0))
        left = gradient - hessian @ best
        half = intervals95(NormalEquations(hessian, left, np.zeros(30))).half_width
        inside.extend(np.abs(best - [0.3, -0.2]) < half)
    # Of 200, 190 are expected inside; fewer than 180 come with a chance of 0.1 %.
    assert sum(inside) >= 180


def test_intervals_know_that_an_error_comes_back_in_every_window_of_a_flight():
    rng, inside = np.random.default_rng(2), {"windows": [], "flights": []}
    flight = np.repeat(np.arange(6), 8)
    for _ in range(100):
        slope = rng.standard_normal((6, 1, 20, 2)) + 0.3 * rng.standard_normal((6, 8, 20, 2))
        residual = rng.standard_normal((6, 1, 20, 1)) + 0.1 * rng.standard_normal((6, 8, 20, 1))
        hessian, gradient = products(slope.reshape(48, 20, 2), residual.reshape(48, 20, 1))
        best = np.linalg.solve(hessian.sum(0), gradient.sum(0))
        left = NormalEquations(hessian, gradient - hessian @ best, np.zeros(48), flight)
        inside["windows"].extend(np.abs(best) < intervals95(left).half_width)
        inside["flights"].extend(np.abs(best) < intervals95(left, 1.0).half_width)
    assert np.mean(inside["windows"]) < 0.7
    assert np.mean(inside["flights"]) > 0.88


def test_intervals_by_flights_hold_the_truth_however_many_numbers_are_fitted():
    """An error that comes back in every window of a flight: 4 flights, 3 numbers.

    By the flights' slopes alone 80 % of the intervals hold the truth.
    """
    rng, flight = np.random.default_rng(2), np.repeat(np.arange(4), 5)
    inside = []
    for _ in range(400):
        slope = rng.standard_normal((4, 1, 3))[flight] + 0.5 * rng.standard_normal((20, 40, 3))
        residual = rng.standard_normal((20, 40, 1)) + rng.standard_normal((4, 1, 1))[flight]
        hessian, gradient = products(slope, residual)
        best = np.linalg.solve(hessian.sum(0), gradient.sum(0))
        left = NormalEquations(hessian, gradient - hessian @ best, np.zeros(20), flight)
        inside.append(np.abs(best) <= intervals95(left, 1.0).half_width)
    assert 0.93 < np.mean(inside) < 0.99

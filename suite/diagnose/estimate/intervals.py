"""95 % intervals of fitted numbers: by the noise, by blocks, by flights, by leaving flights out."""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student

from suite.diagnose.estimate.gauss_newton import NormalEquations


def half_widths95(
    equations: NormalEquations, flight: np.ndarray | None = None, noise_freedom: int | None = None
) -> np.ndarray:
    """Return half-widths (K,) of 95 % intervals at the fit whose normal equations these are.

    The largest of these counts: by the covariance of the noise (Gauss-Newton), and by the one in
    which each window's slope is one draw (the block sandwich; Liang and Zeger 1986), which holds
    where errors within a window are not independent. With `flight` (W,), the number of each
    window's flight, one in which each flight is one draw: a model's error comes back in every
    window of a flight. The noise is known with `noise_freedom` degrees of freedom, that of the
    windows if not given.

    Few flights pull a fit of several numbers towards what they themselves want, so that by their
    slopes it is surer than it is: each flight is left out in turn as well (jackknife).
    """
    count, size = equations.gradient.shape
    if not size:
        return np.zeros(0)
    hessian = equations.hessian.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(hessian), 1e-300))
    inverse = np.linalg.pinv(hessian * np.outer(scale, scale)) * np.outer(scale, scale)

    def by_draws(gradient: np.ndarray, freedom: int) -> np.ndarray:
        centred = gradient - gradient.mean(axis=0)
        blocks = inverse @ (centred.T @ centred * len(gradient) / freedom) @ inverse
        return np.sqrt(np.maximum(np.diag(blocks), 0.0)) * float(student.ppf(0.975, freedom))

    freedom = max(count - size, 2)
    known = float(student.ppf(0.975, noise_freedom or freedom))
    widths = np.sqrt(np.maximum(np.diag(inverse), 0.0)) * known
    widths = np.maximum(widths, by_draws(equations.gradient, freedom))
    numbers = [] if flight is None else np.unique(flight)
    if len(numbers) > 2:
        flights = np.array([equations.gradient[flight == one].sum(axis=0) for one in numbers])
        told = np.array([equations.hessian[flight == one].sum(axis=0) for one in numbers])
        widths = np.maximum(widths, by_draws(flights, len(flights) - 1))
        widths = np.maximum(widths, _by_leaving_out(told, flights, scale))
    return widths


def _by_leaving_out(hessian: np.ndarray, gradient: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Return half-widths (K,) from the solutions without each of F flights.

    Args:
        hessian: (F, K, K) of each flight.
        gradient: (F, K), likewise.
        scale: (K,) of the numbers.
    """
    count = len(gradient)
    rest = (hessian.sum(axis=0) - hessian) * np.outer(scale, scale)
    slopes = (gradient.sum(axis=0) - gradient) * scale
    found = scale * np.einsum("fij,fj->fi", np.linalg.pinv(rest, hermitian=True), slopes)
    spread = (count - 1) / count * np.sum((found - found.mean(axis=0)) ** 2, axis=0)
    return np.sqrt(spread) * float(student.ppf(0.975, count - 1))

"""95 % intervals of the fitted numbers, from how windows disagree and from the noise."""

from __future__ import annotations

import numpy as np
from scipy.stats import t as student

from suite.diagnose.fit.normal_equations import Sums


def errors_of(sums: Sums) -> np.ndarray:
    """Return half-widths (K,) of 95 % intervals at the fit whose sums these are.

    The larger of two covariances counts: that of the measurement noise (Gauss-Newton), and the
    one in which each window's slope is one draw (the block sandwich; Liang and Zeger 1986), which
    holds where errors within a window are not independent.
    """
    count, size = sums.cross.shape
    if not size:
        return np.zeros(0)
    square = sums.square.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(square), 1e-300))
    inverse = np.linalg.pinv(square * np.outer(scale, scale)) * np.outer(scale, scale)
    centred = sums.cross - sums.cross.mean(axis=0)
    freedom = max(count - size, 2)
    blocks = inverse @ (centred.T @ centred * count / freedom) @ inverse
    variance = np.maximum(np.diag(inverse), np.diag(blocks))
    return np.sqrt(np.maximum(variance, 0.0)) * float(student.ppf(0.975, freedom))

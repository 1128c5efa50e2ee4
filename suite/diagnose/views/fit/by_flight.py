"""Moments by the flight that they are of: means, what is off them, what is left out together."""

from __future__ import annotations

import numpy as np


def means_of(values: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return the mean (F, ...) of `values` (M, ...) over each flight; `flight` (M,) numbers it."""
    return np.array([values[flight == number].mean(axis=0) for number in np.unique(flight)])


def centred(values: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """Return `values` (M, ...) less the mean of each's flight."""
    _, place = np.unique(flight, return_inverse=True)
    return values - means_of(values, flight)[place.ravel()]


def units_of(flight: np.ndarray) -> np.ndarray:
    """Return what is left out together (M,): flights, or thirds of a lone one."""
    if len(np.unique(flight)) > 1:
        return flight
    return np.arange(len(flight)) * 3 // len(flight)

"""Coloured noise and a drift, fitted to the variogram that both have in theory."""

import numpy as np
import pytest

from suite.diagnose.sensors import colour
from suite.diagnose.sensors.colour import Series, fit_colour

SD, LASTS_S, DRIFT, SPEED, LONG_S, ROWS = 0.03, 0.2, 0.05, 3.0, 60.0, 600


def exact(flights, lag_s):
    """Return two stretches with the expected variogram; None: variance about a flight's mean.

    The noise decays with `LASTS_S` (its mean: Taylor 1921). A walk W(t) of the variance d a second
    has the variogram d l / 2, and about its mean over D the variance d D / 6.
    """
    per_s, ratio = DRIFT**2 * SPEED, LASTS_S / LONG_S
    if lag_s is None:
        of_mean = 2.0 * ratio * (1.0 - ratio * (1.0 - np.exp(-1.0 / ratio)))
        value = np.array([SD**2 * (1.0 - of_mean) + per_s * LONG_S / 6.0])
    else:
        value = SD**2 * (1.0 - np.exp(-lag_s / LASTS_S)) + 0.5 * per_s * lag_s
    half = np.full((2, len(value)), 0.5)
    return colour._Variograms(2.0 * half * value, half, np.full((2, 1), SPEED), np.arange(2))


def test_a_drift_and_the_noise_around_it_have_their_true_sizes(monkeypatch):
    monkeypatch.setattr(colour, "_variograms", exact)
    flight = Series(np.zeros(ROWS), np.full(ROWS, SPEED), LONG_S / ROWS)
    found = fit_colour([flight, flight])
    assert found is not None
    fitted = found.noise.value, found.lasts_s.value, found.drift.value
    # At the shortest lag of the drift's fit, 2 s, exp(-10) of the noise is still correlated.
    assert fitted == pytest.approx((SD, LASTS_S, DRIFT), rel=1e-3)


def test_a_drift_of_flights_is_significant_and_within_its_interval():
    rng, count, step_s = np.random.default_rng(3), 60, 0.1
    steps = DRIFT * np.sqrt(SPEED * step_s) * rng.normal(size=(count, 4, ROWS))
    values = SD * rng.normal(size=steps.shape) + steps.cumsum(axis=2)
    found = [
        colour._drift([Series(value, np.full(ROWS, SPEED), step_s) for value in flights])
        for flights in values
    ]
    assert sum(drift.low > 0.0 for drift in found) > 0.6 * count
    assert sum(drift.low <= DRIFT <= drift.high for drift in found) > 0.85 * count
    assert np.median([drift.value for drift in found]) == pytest.approx(DRIFT, rel=0.1)


def test_rows_without_a_velocity_are_not_rows_at_rest():
    speed = np.full(ROWS, SPEED)
    speed[50:90] = np.nan
    value = np.where(np.isnan(speed), np.nan, np.random.default_rng(5).normal(size=ROWS))
    found = colour._variograms([Series(value, speed, 0.1)], np.array([1.0]))
    assert found is not None
    np.testing.assert_allclose(found.speed, SPEED)

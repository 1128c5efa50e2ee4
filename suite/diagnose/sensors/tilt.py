"""Tilt error of an estimator that neglects drag: the sensor model `drag_tilt`, fitted to errors.

Such an estimator takes the deceleration by drag for a tilt of the vehicle. The tilt follows the
velocity with a first-order lag, whose time constant is called correlation time. Both are fitted to
errors of the attitude by least squares (`identify/fit.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from eval.judging.statistics import Interval
from suite.diagnose.identify.fit import Rows, Unknown, fit
from suite.diagnose.sensors.errors import Errors, rows_of, significant, size_of
from tracks.geometry.rotation import to_local

TILT = slice(6, 9)
"""Channels of the attitude among the errors. All three axes are fitted: if a body leans, a tilt
about a horizontal world axis has a part about the body's z axis."""
DRAG = Unknown("drag", 0.3, -2.0, 5.0, np.inf, 1e-2)
LOG_LASTS = Unknown("log_lasts", 0.0, np.log(0.05), np.log(10.0), np.inf, 1e-2)
"""The fitted parameters: the drag [1/s], and the logarithm of the correlation time in seconds. The
drag does not start at 0, where the correlation time has no effect."""
LOG_LIMITS = (-20.0, 20.0)
"""Limits of the logarithm of the correlation time's interval."""


class Tilt(NamedTuple):
    """The fitted `drag_tilt`; zeros where the drag is not significant."""

    drag: Interval
    """Drag that the estimator neglects [1/s]."""
    lasts_s: Interval
    """Correlation time of the tilt [s]."""

    def errors(self, flight: Errors) -> np.ndarray:
        """Return the errors (T, 9) of a flight that this tilt explains."""
        explained = np.zeros_like(flight.value)
        if self.drag.value:
            explained[:, TILT] = self.drag.value * lean(flight, self.lasts_s.value)
        return explained


NO_TILT = Tilt(Interval(0.0, 0.0, 0.0), Interval(0.0, 0.0, 0.0))
"""No significant tilt error."""


def lean(flight: Errors, lasts_s: float) -> np.ndarray:
    """Return the attitude error (T, 3) in body axes for a drag of 1/s, see `drag_tilt`.

    `lasts_s` is the correlation time [s].
    """
    # A first-order lag of the tilt in steady flight; `kept` is what remains of it after a row.
    steady_w, kept = np.nan_to_num(flight.lean_w), np.exp(-flight.step_s / lasts_s)
    lean_w, _ = lfilter([1.0 - kept], [1.0, -kept], steady_w, axis=0, zi=kept * steady_w[:1])
    return to_local(flight.rot_w, lean_w[-len(flight.value) :])


def fit_tilt(flights: Sequence[Errors]) -> Tilt:
    """Return the tilt error with its intervals, from the errors at the fitted delay."""
    if not any(np.isfinite(flight.value[:, TILT]).any() for flight in flights):
        return NO_TILT

    def residuals(value: np.ndarray) -> list[Rows]:
        """Return the errors that remain with a drag and the logarithm of a correlation time."""
        drag, lasts_s = float(value[0]), float(np.exp(value[1]))
        return [rows_of(one, one.value[:, TILT] - drag * lean(one, lasts_s)) for one in flights]

    noise = size_of([one.value[:, TILT] for one in flights])
    fitted = fit(residuals, [DRAG, LOG_LASTS], noise=noise)
    drag, log_lasts = fitted.interval("drag"), fitted.interval("log_lasts")
    if drag.value <= 0.0 or not significant(drag):
        return NO_TILT
    return Tilt(drag, Interval(*np.exp(np.clip(log_lasts, *LOG_LIMITS)).tolist()))

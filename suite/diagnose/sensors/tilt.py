"""Tilt error of an estimator that neglects drag: the sensor model `drag_tilt`, fitted to errors.

Such an estimator takes the deceleration by drag for a tilt of the vehicle. The tilt follows the
velocity with a first-order lag, whose time constant is called correlation time. The drag is fitted
to errors of the attitude by least squares for each correlation time, and the best time is searched.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import fminbound
from scipy.signal import lfilter

from eval.judging.statistics import Interval
from suite.diagnose.estimate.gauss_newton import intervals95
from suite.diagnose.sensors.errors import DIFFER_P, Errors, equations_of, significant
from tracks.geometry.rotation import to_local

TILT = slice(6, 9)
"""Channels of the attitude among the errors. All three axes are fitted: if a body leans, a tilt
about a horizontal world axis has a part about the body's z axis."""
LASTS_S = (0.05, 10.0)
"""Smallest and largest correlation time that is tried [s]."""
CHANGE = 0.01
"""Relative change of the correlation time in the finite difference along it."""


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

    def columns(log_s: float, drag: float = 0.0) -> list[np.ndarray]:
        """Return for each flight the remaining errors and two slopes, (T, 3, 3).

        The slopes are along the drag and along the logarithm `log_s` of the correlation time.
        """
        result = []
        for flight in flights:
            tilt, later_tilt = (lean(flight, np.exp(log_s + change)) for change in (0.0, CHANGE))
            slope = drag * (later_tilt - tilt) / CHANGE
            residual = flight.value[:, TILT] - drag * tilt
            result.append(np.stack([residual, tilt, slope], axis=-1))
        return result

    def drag_at(log_s: float) -> tuple[float, float]:
        """Return the best drag at a correlation time, and by how much it lowers the squares."""
        hessian, gradient = equations_of(flights, columns(log_s)).sums()
        best_drag = float(gradient[0]) / max(float(hessian[0, 0]), 1e-300)
        return best_drag, best_drag * float(gradient[0])

    # Search the correlation time, then fit both parameters once more for the intervals.
    log_s = float(np.squeeze(fminbound(lambda at: -drag_at(at)[1], *np.log(LASTS_S))))
    drag = max(drag_at(log_s)[0], 0.0)
    if not drag:
        return NO_TILT
    equations = equations_of(flights, columns(log_s, drag))
    half = intervals95(equations, DIFFER_P, leave_out=True).half_width
    result = Interval(drag, drag - float(half[0]), drag + float(half[0]))
    if not significant(result):
        return NO_TILT
    # The interval of a logarithm becomes a factor.
    lasts_s, factor = float(np.exp(log_s)), float(np.exp(min(half[1], 20.0)))
    return Tilt(result, Interval(lasts_s, lasts_s / factor, lasts_s * factor))

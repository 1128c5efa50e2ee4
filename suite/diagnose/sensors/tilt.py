"""Tilt error of an estimator that neglects drag: `drag_tilt` fitted to errors of the attitude.

The drag is fitted by least squares at each correlation time; the best time is searched.
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
"""Channels of the errors: the attitude. A body that leans yaws by a tilt about world axes."""
LASTS_S = (0.05, 10.0)
"""Correlation times that are tried [s]."""
CHANGE = 0.01
"""Relative change of the correlation time for its slope."""


class Tilt(NamedTuple):
    """The fitted `drag_tilt`; zeros where the drag is not significant."""

    drag: Interval
    """[1/s]."""
    lasts_s: Interval
    """[s]."""

    def errors(self, flight: Errors) -> np.ndarray:
        """Return the errors (T, 9) that it explains."""
        found = np.zeros_like(flight.value)
        if self.drag.value:
            found[:, TILT] = self.drag.value * lean(flight, self.lasts_s.value)
        return found


NO_TILT = Tilt(Interval(0.0, 0.0, 0.0), Interval(0.0, 0.0, 0.0))


def lean(flight: Errors, lasts_s: float) -> np.ndarray:
    """Return the attitude error (T, 3), body axes, for a drag of 1/s, as `drag_tilt` has it [s]."""
    steady_w, kept = np.nan_to_num(flight.lean_w), np.exp(-flight.step_s / lasts_s)
    lean_w, _ = lfilter([1.0 - kept], [1.0, -kept], steady_w, axis=0, zi=kept * steady_w[:1])
    return to_local(flight.rot_w, lean_w[-len(flight.value) :])


def fit_tilt(flights: Sequence[Errors]) -> Tilt:
    """Return the tilt error with its intervals, from the errors at the fitted delay."""
    if not any(np.isfinite(flight.value[:, TILT]).any() for flight in flights):
        return NO_TILT

    def columns(log_s: float, drag: float = 0.0) -> list[np.ndarray]:
        """Return errors and their slopes (T, 3, 3) along the drag and the logarithm of the time."""
        found = []
        for flight in flights:
            one, other = (lean(flight, np.exp(log_s + change)) for change in (0.0, CHANGE))
            slope = drag * (other - one) / CHANGE
            left = flight.value[:, TILT] - drag * one
            found.append(np.stack([left, one, slope], axis=-1))
        return found

    def drag_at(log_s: float) -> tuple[float, float]:
        """Return the best drag at a correlation time, and the fall of the squares."""
        hessian, gradient = equations_of(flights, columns(log_s)).sums()
        fall = float(gradient[0]) / max(float(hessian[0, 0]), 1e-300)
        return fall, fall * float(gradient[0])

    log_s = float(np.squeeze(fminbound(lambda at: -drag_at(at)[1], *np.log(LASTS_S))))
    drag = max(drag_at(log_s)[0], 0.0)
    if not drag:
        return NO_TILT
    equations = equations_of(flights, columns(log_s, drag))
    half = intervals95(equations, DIFFER_P, leave_out=True).half_width
    found = Interval(drag, drag - float(half[0]), drag + float(half[0]))
    if not significant(found):
        return NO_TILT
    lasts_s, wide = float(np.exp(log_s)), float(np.exp(min(half[1], 20.0)))
    return Tilt(found, Interval(lasts_s, lasts_s / wide, lasts_s * wide))

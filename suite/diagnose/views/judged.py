"""What a view's names are worth on flights that took no part, beside what a black box is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from suite.diagnose.views.explainable import closed_share, fit_black_box, inputs_of
from suite.diagnose.views.fit.by_flight import centred
from suite.diagnose.views.fit.compare import ViewData
from suite.diagnose.views.fit.equations import ViewTask, left_of
from suite.diagnose.views.fit.search import ViewSearch


class ViewGap(NamedTuple):
    """One view's errors on held-out flights, by axis of the body."""

    before: np.ndarray
    """(3,) RMS as given [the view's unit]."""
    after: np.ndarray
    """(3,) with what was named."""
    floor: np.ndarray
    """(3,) what measurement noise gives."""
    repeatability: np.ndarray
    """(3,) how flights' means differ among themselves; NaN where too few flights tell it."""
    closed: np.ndarray
    """(3,) share of the variance within flights that the names close."""
    explainable: np.ndarray
    """(3,) share that a black box, fitted to the same flights, closes."""
    left: np.ndarray
    """(3,) share that a black box closes of it beyond the names."""
    variance: np.ndarray
    """(3,) within flights, as given."""

    def share(self, by_axis: np.ndarray) -> float:
        """Return a share by axis (3,) as one of all axes together, at least 0."""
        return float(max((by_axis * self.variance).sum() / max(self.variance.sum(), 1e-12), 0.0))

    def rms(self, by_axis: np.ndarray) -> float:
        """Return the root of the sum of squares over the axes of errors (3,)."""
        return float(np.sqrt((by_axis**2).sum()))


def judge(found: ViewSearch, held: ViewTask, floor: np.ndarray) -> ViewGap:
    """Return what `found` is worth on the flights of `held`; `floor` (3,) is the noise's."""
    before, after = left_of(held, found.first.theta), left_of(held, found.last.theta)
    if held.means:
        return _judge_change(found, before, after, floor)
    start, fitted = found.first.data, found.last.data
    inside = np.concatenate([inputs_of(flight) for flight in found.task.flights])
    outside = np.concatenate([inputs_of(flight) for flight in held.flights])
    numbers = before.flight
    whole = fit_black_box(inside, start.residual, start.flight)
    beyond = fit_black_box(inside, fitted.residual, fitted.flight)
    shares = [
        closed_share(before.residual, left, numbers)
        for left in (
            after.residual,
            before.residual - whole.predict(outside),
            after.residual - beyond.predict(outside),
        )
    ]
    closed, explainable, both = shares
    return ViewGap(
        before=_rms(before.residual),
        after=_rms(after.residual),
        floor=floor,
        repeatability=_finite(found.last.weights.trim),
        closed=closed,
        explainable=np.maximum(explainable, closed),
        left=both - closed,
        variance=(centred(before.residual, numbers) ** 2).mean(axis=0),
    )


def _judge_change(
    found: ViewSearch, before: ViewData, after: ViewData, floor: np.ndarray
) -> ViewGap:
    """Return what the names of a change are worth: means alone count."""
    power = (before.residual**2).mean(axis=0)
    closed = 1.0 - (after.residual**2).mean(axis=0) / np.maximum(power, 1e-12)
    return ViewGap(
        before=_rms(before.residual),
        after=_rms(after.residual),
        floor=floor,
        repeatability=_finite(found.first.weights.trim),
        closed=closed,
        explainable=np.maximum(closed, 0.0),
        left=np.zeros(3),
        variance=power,
    )


def gap_without(found: ViewSearch, held: ViewTask, indices: Sequence[int]) -> np.ndarray:
    """Return the RMS (3,) on held-out flights where the numbers at `indices` are as given."""
    theta = found.last.theta.copy()
    theta[list(indices)] = found.first.theta[list(indices)]
    return _rms(left_of(held, theta).residual)


def _rms(residual: np.ndarray) -> np.ndarray:
    return np.sqrt((residual**2).mean(axis=0))


def _finite(trim: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(trim), trim, np.nan)

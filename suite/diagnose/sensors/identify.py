"""A sensors model from flights that have an estimate and a reference, and its held-out check."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from eval.judging.statistics import Interval
from eval.logs.flight_log import FlightLog
from eval.sensors.measured_state import AXES, GROUPS
from suite.diagnose.sensors.colour import SHORT_S, Coloured, Series, fit_colour
from suite.diagnose.sensors.errors import Errors, errors_of
from suite.diagnose.sensors.lateness import Lateness, acting, fit_lateness, without

WITHIN = 0.2
"""A colour fits where its autocorrelation is nowhere further than this from the measured one."""
COUNTS = 0.2
"""Measured autocorrelations from here on are compared in relative terms as well."""


class Fitted(NamedTuple):
    """Errors of an estimate, as flights show them."""

    lateness: Lateness
    axes: Mapping[str, Coloured]
    """By axis, those that could be fitted."""
    drift: Interval
    """Of the position, over its axes [m/sqrt(m)]."""


class HeldOut(NamedTuple):
    """The fitted autocorrelation of one axis against that of flights that it was not fitted to."""

    lag_s: float
    """Where they differ most [s]."""
    measured: float
    fitted: float
    largest: float
    """The largest difference, in units of the autocorrelation at lag 0."""
    relative: float
    """The largest difference over the measured value, where that is at least `COUNTS`."""
    size_ratio: float
    """Fitted standard deviation over the held-out one."""

    @property
    def fits(self) -> bool:
        """Whether the difference is within `WITHIN` at every lag."""
        return self.largest <= WITHIN


def fit_sensors(logs: Sequence[FlightLog]) -> Fitted:
    """Return the errors of the estimate in flights.

    Raises:
        FlightLogError: for a log without an estimate or without a reference.
    """
    lateness, flights = fit_lateness(logs)
    axes = {}
    for c, axis in enumerate(AXES):
        found = fit_colour(_series(flights, lateness, c))
        if found is not None:
            axes[axis] = found
    drifts = [axes[axis].drift for axis in AXES[:3] if axis in axes]
    mean = (float(np.sqrt(np.mean(np.square(ends)))) for ends in zip(*drifts, strict=True))
    return Fitted(lateness, axes, Interval(*mean) if drifts else Interval(0.0, 0.0, 0.0))


def held_out(logs: Sequence[FlightLog]) -> dict[str, HeldOut]:
    """Return by axis how a model fitted to one half of the flights is off on the other half.

    Both halves are held out in turn, and the worse counts; nothing is held out of one flight.
    """
    worst: dict[str, HeldOut] = {}
    for half in (0, 1) if len(logs) > 1 else ():
        fitted = fit_sensors(logs[half::2])
        late_s = acting(fitted.lateness.delay_s)
        other = [errors_of(log, late_s) for log in logs[1 - half :: 2]]
        for c, axis in enumerate(AXES):
            series = _series(other, fitted.lateness, c)
            if axis not in fitted.axes or not any(np.isfinite(s.value).any() for s in series):
                continue
            found = _compared(fitted.axes[axis], series)
            if axis not in worst or found.largest > worst[axis].largest:
                worst[axis] = found
    return worst


def _compared(fitted: Coloured, series: Sequence[Series]) -> HeldOut:
    step_s = max(flight.step_s for flight in series)
    lags = np.arange(round(SHORT_S / step_s) + 1)
    duration_s = float(np.mean([len(flight.value) * flight.step_s for flight in series]))
    variance, measured = _autocorrelation(series, lags)
    model = fitted.correlation(lags * step_s, duration_s)
    off = np.abs(model - measured)
    most, count = int(off.argmax()), np.abs(measured) >= COUNTS
    return HeldOut(
        float(lags[most] * step_s),
        float(measured[most]),
        float(model[most]),
        float(off[most]),
        float((off[count] / np.abs(measured[count])).max()),
        float(fitted.noise.value / np.sqrt(variance)),
    )


def _autocorrelation(series: Sequence[Series], lags: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the variance of all flights and the autocorrelation (L,) at `lags` steps."""
    total, pairs = np.zeros(len(lags)), np.zeros(len(lags))
    for flight in series:
        centred = flight.value - np.nanmean(flight.value)
        for place, lag in enumerate(lags.tolist()):
            both = centred[lag:] * centred[: len(centred) - lag]
            total[place] += np.nansum(both)
            pairs[place] += np.isfinite(both).sum()
    covariance = total / np.maximum(pairs, 1)
    return float(covariance[0]), covariance / covariance[0]


def _series(flights: Sequence[Errors], lateness: Lateness, channel: int) -> list[Series]:
    """Return one error of every flight, less what a scale explains."""
    found = []
    for flight in flights:
        values = without(flight, acting(lateness.velocity_scale))[:, channel]
        speed = np.linalg.norm(flight.vel_b, axis=1)
        drifts = AXES[channel].startswith("position")
        found.append(Series(values, speed if drifts else 0.0 * speed, flight.step_s))
    return found


def parameters_of(fitted: Fitted) -> dict[str, tuple[Interval, str]]:
    """Return each parameter of the sensors file with its interval and its unit."""
    found = {"delay.state": (fitted.lateness.delay_s, "s")}
    for axis, one in fitted.axes.items():
        unit = GROUPS[axis.split("_")[0]][0]
        found |= {
            f"measured_state.{axis}": (one.noise, unit),
            f"measured_state.{axis}_bias": (one.bias, unit),
            f"measured_state.{axis}_lasts": (one.lasts_s, "s"),
        }
        if one.fast.value:
            found[f"measured_state.{axis}_fast"] = (one.fast, "1")
            found[f"measured_state.{axis}_fast_lasts"] = (one.fast_s, "s")
    found["measured_state.velocity_scale"] = (fitted.lateness.velocity_scale, "1")
    found["measured_state.position_drift"] = (fitted.drift, "m/sqrt(m)")
    return found

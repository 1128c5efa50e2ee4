"""A sensors file from flights that have an estimate and a reference, and its held-out check."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eval.judging.statistics import Interval
from eval.logs.columns import FlightLogError
from eval.logs.flight_log import FlightLog, read_flights
from eval.sensors import SENSORS
from eval.sensors.measured_state import AXES, GROUPS
from eval.sensors.sensors_file import save_sensors, sensor_set
from suite.common.console import Console
from suite.common.provenance import stamp
from suite.delta.run import flight_files
from suite.diagnose.identify.numbers import Number, as_json, lines_of_numbers
from suite.diagnose.sensors.colour import SHORT_S, Coloured, Series, fit_colour
from suite.diagnose.sensors.errors import (
    Errors,
    Lateness,
    acting,
    errors_of,
    fit_lateness,
    without,
)

SCHEMA = 1
WITHIN = 0.2
"""A model fits where its autocorrelation is within this of the measured one at every lag."""
COUNTS = 0.2
"""Measured autocorrelations from here on are compared in relative terms as well."""


class Fitted(NamedTuple):
    """Errors of an estimate, fitted to flights."""

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
    """Return by axis how a model fitted to half of the flights differs from the other half.

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


def identify_sensors(flights: Sequence[Path], out: Path, console: Console) -> dict[str, Any]:
    """Fit a sensors model to the estimates in flight logs, and write its file.

    Args:
        flights: logs or folders of them; those without an estimate are named and left out.
        out: the sensors file to write.
        console: for people.

    Returns:
        What `--json` prints.

    Raises:
        ValueError: where no log holds both an estimate and a reference.
    """
    logs, warnings = read_flights(flight_files(flights), partial=True)
    used, seconds, refused = [], 0.0, []
    for log in logs:
        try:
            errors = errors_of(log)
            used.append(log)
            seconds += len(errors.value) * errors.step_s
        except FlightLogError as error:
            refused.append(str(error))
    if not used:
        raise ValueError("no flight can be used:\n" + "\n".join(refused))
    warnings += [f"not used: {text}" for text in refused]
    console.say(f"{len(used)} flights with an estimate and a reference, {seconds:.0f} s in all")
    fitted, checked = fit_sensors(used), held_out(used)
    if not fitted.axes:
        raise ValueError(
            "no axis of the estimate has two stretches of 5 s without a hole; fly longer, or log "
            "the estimate and the reference in the same rows"
        )
    parameters = parameters_of(fitted)
    head = [f"An on-board estimate against a reference in {len(used)} flights; 95 % intervals:"]
    numbers = [
        Number(key, unit, [one.value], [(one.low, one.high)])
        for key, (one, unit) in parameters.items()
    ]
    head += lines_of_numbers(numbers)
    save_sensors(sensor_set(_values(parameters), out.stem), out, "\n".join(head))
    return {
        "sensors": str(out),
        "parameters": as_json(numbers),
        "delay_by_part": {k: list(one) for k, one in fitted.lateness.by_part.items()},
        "held_out": {
            axis: {**one._asdict(), "fits": one.fits, "within": WITHIN}
            for axis, one in checked.items()
        },
        "flights": [log.name for log in used],
        "warnings": warnings,
        **stamp(SCHEMA, None),
    }


def say_held_out(result: Mapping[str, Any], console: Console) -> None:
    """Print how the model fits flights that it was not fitted to."""
    if result["held_out"]:
        console.say("autocorrelation up to 1 s on flights that the model was not fitted to:")
    for axis, one in result["held_out"].items():
        fits = "fits" if one["fits"] else "does not fit"
        console.say(
            f"  {axis} {fits}: {one['fitted']:.2f}, measured {one['measured']:.2f}, at a lag of "
            f"{one['lag_s']:.2f} s where they differ most (allowed {one['within']:g})"
        )


def _values(parameters: Mapping[str, tuple[Interval, str]]) -> dict[str, dict[str, float]]:
    """Return the entries of the file; a delay, scale or drift that may be zero is left out."""
    models: dict[str, dict[str, float]] = {}
    for key, (one, _) in parameters.items():
        model, name = key.split(".")
        noise = model == "measured_state" and name not in ("velocity_scale", "position_drift")
        value = one.value if noise else acting(one)
        limits = next(p for p in SENSORS.find(model).parameters if p.name == name)
        value = min(max(value, float(limits.low)), float(limits.high))  # pyright: ignore[reportArgumentType]
        if noise or value:
            models.setdefault(model, {})[name] = float(f"{value:.4g}")
    return models

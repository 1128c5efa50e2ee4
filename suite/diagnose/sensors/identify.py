"""Identifies a sensors file from flights, and checks it on held-out flights.

A sensors file describes the errors of what a policy observes. Here these are the errors of an
on-board state estimate, relative to a reference pose such as motion capture in the same log.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eval.judging.statistics import Interval
from eval.logs.columns import FlightLogError
from eval.logs.faults.catalogue import FAULTS
from eval.logs.faults.check import CheckContext
from eval.logs.faults.checked import read_checked
from eval.logs.flight_log import FlightLog
from eval.sensors import SENSORS
from eval.sensors.measured_state import AXES, GROUPS
from eval.sensors.sensors_file import save_sensors, sensor_set
from suite.common.console import Console, counted
from suite.common.provenance import stamp
from suite.diagnose.identify.numbers import Number, number_lines, numbers_json
from suite.diagnose.identify.run import MADE_BY
from suite.diagnose.sensors.clock import clock_of, on_gyro_clock
from suite.diagnose.sensors.colour import SHORT_S, Coloured, Series, fit_colour
from suite.diagnose.sensors.errors import (
    ZERO,
    Errors,
    Systematic,
    errors_of,
    fit_systematic,
    significant,
)

SCHEMA = 1
"""Version of the JSON that `suite identify --sensors` prints."""
WITHIN = 0.2
"""Largest difference between the autocorrelations of a model that fits and of the flights."""


class Fitted(NamedTuple):
    """Model of an estimate's errors, fitted to flights."""

    systematic: Systematic
    """Delay of the estimate, scale error of its velocity, and tilt by a neglected drag."""
    axes: Mapping[str, Coloured]
    """Noise parameters by axis (such as `position_x`), of each axis with enough data."""
    drift: Interval
    """Random walk of the position, averaged over its axes [m/sqrt(m)]."""


class HeldOut(NamedTuple):
    """Fitted autocorrelation of one axis, compared with that of held-out flights."""

    lag_s: float
    """Lag at which they differ most [s]."""
    measured: float
    """Autocorrelation of the held-out flights at that lag."""
    fitted: float
    """Autocorrelation of the model at that lag."""
    largest: float
    """Largest difference; an autocorrelation is 1 at lag 0."""

    @property
    def fits(self) -> bool:
        """Whether the difference is within `WITHIN` at every lag."""
        return self.largest <= WITHIN


def fit_sensors(logs: Sequence[FlightLog]) -> Fitted:
    """Fit the errors of the estimate in flights.

    Raises:
        FlightLogError: for a log without an estimate or without a reference.
    """
    systematic, flights = fit_systematic(logs)
    axes = {}
    for channel, axis in enumerate(AXES):
        coloured = fit_colour(_series(flights, systematic, channel))
        if coloured is not None:
            axes[axis] = coloured
    drifts = [axes[axis].drift for axis in AXES[:3] if axis in axes]  # those of the position
    rms = (float(np.sqrt(np.mean(np.square(ends)))) for ends in zip(*drifts, strict=True))
    return Fitted(systematic, axes, Interval(*rms) if drifts else ZERO)


def held_out(logs: Sequence[FlightLog]) -> dict[str, HeldOut]:
    """Compare a model that was fitted to half of the flights with the other half, both ways.

    The result has the larger difference, by axis. It is empty for a single flight.
    """
    worst: dict[str, HeldOut] = {}
    for half in (0, 1) if len(logs) > 1 else ():
        fitted = fit_sensors(logs[half::2])
        late_s = significant(fitted.systematic.delay_s)
        flights = [errors_of(log, late_s) for log in logs[1 - half :: 2]]
        for channel, axis in enumerate(AXES):
            series = _series(flights, fitted.systematic, channel)
            if axis not in fitted.axes or not series:
                continue
            compared = _compare(fitted.axes[axis], series)
            if axis not in worst or compared.largest > worst[axis].largest:
                worst[axis] = compared
    return worst


def _compare(fitted: Coloured, series: Sequence[Series]) -> HeldOut:
    """Compare the autocorrelation of a model with that of held-out flights, up to `SHORT_S`."""
    step_s = max(flight.step_s for flight in series)
    lag_s = step_s * np.arange(round(SHORT_S / step_s) + 1)
    duration_s = float(np.mean([flight.duration_s for flight in series]))
    measured = _autocorrelation(series, lag_s)
    model = fitted.correlation(lag_s, duration_s)
    difference = np.abs(model - measured)
    worst = int(difference.argmax())
    shown = (lag_s[worst], measured[worst], model[worst], difference[worst])
    return HeldOut(*map(float, shown))


def _autocorrelation(series: Sequence[Series], lag_s: np.ndarray) -> np.ndarray:
    """Return the autocorrelation (L,) of all flights at `lag_s` (L,) [s]."""
    total, pairs = np.zeros(len(lag_s)), np.zeros(len(lag_s))
    for flight in series:
        centred = flight.value - np.nanmean(flight.value)
        for place, lag in enumerate(np.rint(lag_s / flight.step_s).astype(int).tolist()):
            product = centred[lag:] * centred[: len(centred) - lag]
            total[place] += np.nansum(product)
            pairs[place] += np.isfinite(product).sum()
    covariance = total / np.maximum(pairs, 1)
    return covariance / covariance[0]


def _series(flights: Sequence[Errors], systematic: Systematic, channel: int) -> list[Series]:
    """Return the errors of one channel in each flight that has any, to fit their noise."""
    series, can_drift = [], AXES[channel].startswith("position")
    for flight in flights:
        speed = np.linalg.norm(flight.vel_b, axis=1)
        values = systematic.removed(flight)[:, channel]
        if np.isfinite(values).any():
            series.append(Series(values, speed if can_drift else 0.0 * speed, flight.step_s))
    return series


def parameters_of(fitted: Fitted) -> dict[str, tuple[Interval, str]]:
    """Return each parameter of the sensors file with its interval and its unit."""
    delay_s, velocity_scale, drag, tilt_lasts_s = fitted.systematic
    parameters = {"delay.state": (delay_s, "s")}
    for axis, coloured in fitted.axes.items():
        unit = GROUPS[axis.split("_")[0]][0]
        parameters |= {
            f"measured_state.{axis}": (coloured.noise, unit),
            f"measured_state.{axis}_bias": (coloured.bias, unit),
            f"measured_state.{axis}_lasts": (coloured.lasts_s, "s"),
        }
        if coloured.fast.value:
            parameters[f"measured_state.{axis}_fast"] = (coloured.fast, "1")
            parameters[f"measured_state.{axis}_fast_lasts"] = (coloured.fast_s, "s")
    parameters["measured_state.velocity_scale"] = (velocity_scale, "1")
    parameters["measured_state.position_drift"] = (fitted.drift, "m/sqrt(m)")
    if drag.value:
        parameters["drag_tilt.drag"] = (drag, "1/s")
        parameters["drag_tilt.lasts"] = (tilt_lasts_s, "s")
    return parameters


def identify_sensors(flights: Sequence[Path], out: Path, console: Console) -> dict[str, Any]:
    """Fit a sensors model to the estimates in flight logs, and write its file.

    A log without an estimate gives a warning, as does each fault that the checks of a log find.
    Returned is the JSON object that `--json` prints.

    Raises:
        ValueError: if no log has both an estimate and a reference, or no axis has enough data.
    """
    checked = read_checked(flights, CheckContext(), list(FAULTS), partial=True)
    used, seconds, refused = [], 0.0, []
    for log in checked.logs:
        try:
            errors = errors_of(log)
            used.append(log)
            seconds += len(errors.value) * errors.step_s
        except FlightLogError as error:
            refused.append(str(error))
    if not used:
        raise ValueError("no flight can be used:\n" + "\n".join(refused))
    warnings = [*checked.warnings, *(f"not used: {text}" for text in refused)]
    flown = counted(len(used), "flight")
    console.say(f"{flown} with an estimate and a reference, {seconds:.0f} s in all")
    # Move each reference to the gyro's clock, fit, and check on held-out flights.
    clocks = [clock_of(log) for log in used]
    clocks_s = {
        log.name: [float(clock.shift_s.min()), float(clock.shift_s.max())]
        for log, clock in zip(used, clocks, strict=True)
        if clock.shift_s.any()
    }
    used = [on_gyro_clock(log, clock) for log, clock in zip(used, clocks, strict=True)]
    fitted, compared = fit_sensors(used), held_out(used)
    if not fitted.axes:
        raise ValueError(
            "no axis of the estimate has two stretches of 5 s without a hole; fly longer, or log "
            "the estimate and the reference in the same rows"
        )
    parameters = parameters_of(fitted)
    header = [f"An on-board estimate {MADE_BY} against a reference, {flown}; 95 % intervals:"]
    if clocks_s:
        low = 1e3 * min(least for least, _ in clocks_s.values())
        high = 1e3 * max(largest for _, largest in clocks_s.values())
        text = (
            f"In {len(clocks_s)} of them the gyro is {low:.0f} to {high:.0f} ms later than the "
            "reference; the reference was moved to the gyro's times."
        )
        console.say(text)
        header.append(text)
    numbers = [
        Number(key, unit, [interval.value], [(interval.low, interval.high)])
        for key, (interval, unit) in parameters.items()
    ]
    header += number_lines(numbers)
    values, notes = _file_values(parameters)
    save_sensors(sensor_set(values, out.stem), out, "\n".join(header))
    return {
        "sensors": str(out),
        "parameters": numbers_json(numbers),
        "held_out": {
            axis: {**one._asdict(), "fits": one.fits, "within": WITHIN}
            for axis, one in compared.items()
        },
        "clock_s": clocks_s,
        "findings": checked.findings,
        "flights": [log.name for log in used],
        "warnings": [*warnings, *notes],
        **stamp(SCHEMA, None),
    }


def say_held_out(result: Mapping[str, Any], console: Console) -> None:
    """Print how the model fits held-out flights; `result` is from `identify_sensors`."""
    if result["held_out"]:
        console.say("autocorrelation up to 1 s on flights that the model was not fitted to:")
    for axis, compared in result["held_out"].items():
        fits = "fits" if compared["fits"] else "does not fit"
        console.say(
            f"  {axis} {fits}: {compared['fitted']:.2f}, measured {compared['measured']:.2f}, at a "
            f"lag of {compared['lag_s']:.2f} s where they differ most (allowed "
            f"{compared['within']:g})"
        )


def _file_values(
    parameters: Mapping[str, tuple[Interval, str]],
) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Return the entries of the sensors file: parameters by model, then by name.

    A delay, scale or drift whose interval contains 0 is left out. Returned is also a line for
    people for each value that had to differ from the fitted one.
    """
    models, notes = dict[str, dict[str, float]](), list[str]()
    for key, (interval, unit) in parameters.items():
        model, name = key.split(".")
        noise = model == "measured_state" and name not in ("velocity_scale", "position_drift")
        fitted = interval.value if noise else significant(interval)
        limits = next(p for p in SENSORS.find(model).parameters if p.name == name)
        value = min(max(fitted, limits.low), limits.high)
        if value != fitted:
            notes.append(
                f"{key}: these flights give {fitted:.4g} ({interval.low:.4g} to "
                f"{interval.high:.4g}) {unit}; the file has {value:.4g}, the nearest allowed value"
            )
        if noise or value:
            models.setdefault(model, {})[name] = float(f"{value:.4g}")
    return models, notes

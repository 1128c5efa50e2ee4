"""Flights made ready for the views: completed, smoothed, parted into fitted and held-out ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.checks.actuators import wrench_difference
from suite.diagnose.data.completed import completed
from suite.diagnose.data.rotors import ActingRotors, acting_rotors
from suite.diagnose.data.sampling import on_every_row
from suite.diagnose.data.view import (
    FORCE,
    TORQUE,
    FlightRows,
    SmoothedFlight,
    View,
    calibrated,
    rows_of,
    smoothed,
)
from suite.diagnose.data.weak_form import LEAST_ROWS
from suite.diagnose.thresholds import THRESHOLDS, Thresholds

SLOW_WIDTH_S = 1.0
"""Width of the bumps where rates come from a path, which tells them as means over a second [s]."""


@dataclass(frozen=True)
class ViewFlights:
    """Flights, ready for the views that all of them allow."""

    views: tuple[View, ...]
    """What all of them allow."""
    names: tuple[str, ...]
    """Of F flights."""
    smoothed: dict[str, list[SmoothedFlight]]
    """By view, F each."""
    floor: dict[str, np.ndarray]
    """By view: what the velocity's or the rates' noise makes of an acceleration, (3,)."""
    source: str
    """What is taken for the rotors' speeds."""
    kept: tuple[int, ...] = ()
    """Numbers of the logs that these flights are of; others have no stretch."""
    notes: tuple[str, ...] = ()
    """What was left out, in words."""


def ready(
    logs: Sequence[FlightLog], vehicle: Vehicle, limits: Thresholds = THRESHOLDS
) -> ViewFlights:
    """Return those of `logs` that have a stretch, for the views that all of them allow.

    Raises:
        ValueError: where a log has nothing that turns or pushes, or none has a stretch.
    """
    rotors = [acting_rotors(log, vehicle, limits) for log in logs]
    for log, one in zip(logs, rotors, strict=True):
        if one is None:
            needs = "[motors] in the vehicle file" if log.pwm is not None else "thrust or rotors"
            raise ValueError(f"{log.name}: nothing says how its rotors turned; it needs {needs}")
    acting = [one for one in rotors if one is not None]
    whole = [on_every_row(completed(log), limits) for log in logs]
    rows = [
        rows_of(log, vehicle, one.speed, limits) for log, one in zip(whole, acting, strict=True)
    ]
    views = [FORCE]
    if any("quat" in log.partial for log in logs):
        views = [replace(FORCE, axes=(2,))]
    if all(one.each for one in acting):
        slow = any({"quat", "rate"} <= set(log.partial) for log in logs)
        views.append(replace(TORQUE, width_s=SLOW_WIDTH_S) if slow else TORQUE)
    parts = {view.name: [smoothed(view, one, limits) for one in rows] for view in views}
    if TORQUE.name in parts:
        parts[TORQUE.name] = [
            _calibrated(flight, one, vehicle)
            for flight, one in zip(parts[TORQUE.name], acting, strict=True)
        ]
    kept = [k for k, flight in enumerate(parts[FORCE.name]) if len(flight.form.middle_s)]
    without = f"no stretch of {FORCE.width_s:g} s in flight without a hole"
    if not kept:
        raise ValueError(f"{', '.join(log.name for log in logs)}: {without}")
    notes = [f"{log.name}: {without}" for k, log in enumerate(logs) if k not in kept]
    parts = {name: [flights[k] for k in kept] for name, flights in parts.items()}
    for view in views[1:]:
        empty = [
            logs[k].name
            for k, flight in zip(kept, parts[view.name], strict=True)
            if not len(flight.form.middle_s)
        ]
        if empty:
            notes.append(
                f"{view.name}: not looked at, as {', '.join(empty)} has no {view.width_s:g} s "
                f"with {LEAST_ROWS} rows; log faster"
            )
            views, parts = views[:1], {FORCE.name: parts[FORCE.name]}
    return ViewFlights(
        tuple(views),
        tuple(logs[k].name for k in kept),
        parts,
        {view.name: _floor(view, parts[view.name]) for view in views},
        acting[0].source,
        tuple(kept),
        tuple(notes),
    )


def _calibrated(flight: SmoothedFlight, rotors: ActingRotors, vehicle: Vehicle) -> SmoothedFlight:
    if rotors.noise is None:
        return flight
    speed, noise = np.nan_to_num(rotors.speed), np.nan_to_num(rotors.noise)
    _, turned = wrench_difference(speed, np.zeros_like(speed), vehicle)
    _, noisy = wrench_difference(speed + noise, speed, vehicle)
    return calibrated(flight, turned, noisy)


def parted(
    flights: ViewFlights, held: Sequence[int], limits: Thresholds = THRESHOLDS
) -> tuple[dict[str, list[SmoothedFlight]], dict[str, list[SmoothedFlight]]]:
    """Return the fitted flights and the `held` ones by view; of a lone flight its first part.

    Raises:
        ValueError: for a lone flight that is too short to part.
    """
    count = len(flights.names)
    if count > 1:
        inside = [k for k in range(count) if k not in held]
        return (
            {name: [part[k] for k in inside] for name, part in flights.smoothed.items()},
            {name: [part[k] for k in held] for name, part in flights.smoothed.items()},
        )
    first, last = {}, {}
    # Of what was flown: a log may begin or end on the ground.
    flown_s = flights.smoothed[FORCE.name][0].form.middle_s
    until_s = float(np.quantile(flown_s, limits.lone_fitted_share))
    for view in flights.views:
        whole = flights.smoothed[view.name][0]
        rows, credible = whole.rows, whole.credible
        early = rows.time_s <= until_s
        for part, chosen in ((first, early), (last, ~early)):
            some = smoothed(view, _only(rows, chosen), limits)
            if not len(some.form.middle_s):
                raise ValueError(
                    f"{flights.names[0]}: too short to hold a part of it out; fly longer"
                )
            part[view.name] = [some._replace(credible=credible)]
    return first, last


def _only(rows: FlightRows, chosen: np.ndarray) -> FlightRows:
    return rows._replace(good=np.asarray(rows.good) & chosen)


def _floor(view: View, flights: Sequence[SmoothedFlight]) -> np.ndarray:
    """Return the noise (3,) of the measured accelerations, by that of neighbouring rows."""
    power = []
    for flight in flights:
        series = np.asarray(flight.rows.vel_w if view.in_world else flight.rows.rate_b)
        series = series[np.asarray(flight.rows.good)]
        bend = series[2:] - 2.0 * series[1:-1] + series[:-2]
        # Median, for a filter's or an estimator's steps are no noise of every row.
        sigma = np.median(np.abs(bend), axis=0) / 0.6745 / np.sqrt(6.0)
        gain = flight.form.change.power(2).sum(axis=1).mean()
        power.append(sigma**2 * gain)
    floor = np.sqrt(np.mean(power, axis=0))
    return np.full(3, floor.mean()) if view.in_world else floor

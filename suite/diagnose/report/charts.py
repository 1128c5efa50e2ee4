"""Draws the charts of a diagnosis, and records held-out flights for rerun (rerun.io, a viewer)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from eval.view.comparison import ComparedFlight, Simulation, States, write_comparison
from suite.common.charts import plain_axes, png, titled
from suite.diagnose.data.windows import FlightWindows, take
from suite.diagnose.report.summary import superscripts
from suite.diagnose.sources.rollout_source import Rollouts, RolloutSource
from suite.diagnose.sources.source import Series
from tracks.geometry.rotation import exp_rot, rot_to_quat

MEASURED, BEFORE, AFTER = "#1d2430", "#8b93a1", "#2463c9"
"""Colours: measurements, vehicle as given, vehicle with the named effects."""


def series_chart(series: Series) -> bytes:
    """Draw held-out flights, measured and simulated, as a PNG; over time also the errors."""
    figure = Figure(figsize=(9.0, 3.7), layout="constrained")
    is_over_time = series.x_label != "flight"
    panels = figure.subplots(1 + is_over_time, sharex=True, squeeze=False)[:, 0]
    # A wide line below the others shows also where the simulation agrees with it.
    measured: dict[str, Any] = {"lw": 3.2}
    simulated: dict[str, Any] = {"lw": 1.4}
    if not is_over_time:
        measured = {"ls": "", "marker": "o", "ms": 9.0, "mfc": "none"}
        simulated = {"ls": "", "marker": "x", "mew": 2.0}
        panels[0].set_xticks(series.x)
    panels[0].plot(series.x, series.measured, color=MEASURED, label="measured", **measured)
    for (label, values), colour in zip(series.simulated.items(), (BEFORE, AFTER), strict=False):
        panels[0].plot(series.x, values, color=colour, label=label, **simulated)
        if is_over_time:
            panels[1].plot(series.x, series.measured - values, color=colour, lw=1.0)
    label = superscripts(series.label)
    titled(panels[0], label)
    for axes in panels[1:]:
        axes.set_ylabel(f"measured -\nsimulated {label[label.rindex('[') :]}", fontsize=8)
        plain_axes(axes)
    panels[-1].set_xlabel(series.x_label, fontsize=8)
    figure.legend(fontsize=8, frameon=False, ncols=3, loc="outside lower center")
    return png(figure)


def write_rollouts(path: Path, flown: RolloutSource, rollouts: Rollouts) -> Path:
    """Write held-out flights, measured and simulated in `rollouts`, as a recording (.rrd).

    Raises:
        OSError: if the file cannot be written; no partial file remains.
    """
    windows, simulated = rollouts
    flights = []
    for number in np.unique(windows.flight):
        rows = np.flatnonzero(windows.flight == number)
        simulations = []
        for label, residual in simulated.items():
            parts = (_rollout(take(windows, row), residual[row]) for row in rows)
            kept = [part for part in parts if part]  # without those that diverged
            paths, errors = [states for states, _ in kept], [error for _, error in kept]
            simulations.append(Simulation(label, paths, errors))
        log = flown.logs[int(number)]
        time_s = log.time_s - log.time_s[0]
        is_held = time_s >= flown.since_s - 1e-6
        fields = (time_s, log.pos_w, log.quat_wxyz, log.vel_w, log.rate_b)
        measured = States(*(field[is_held] for field in fields))
        flights.append(ComparedFlight(log.name, measured, simulations))
    return write_comparison(path, flights, flown.vehicle.body.half_size)


def _rollout(window: FlightWindows, residual: np.ndarray) -> tuple[States, np.ndarray] | None:
    """Return simulated states and errors of a rollout; None if it diverged.

    They are at its T rows with a measured pose. The errors (T, 4) are those of position [m],
    velocity [m/s], attitude [deg] and rates [rad/s]. `residual` is measured minus simulated.
    """
    is_logged = np.asarray(window.valid)
    rows = is_logged[:, 0] & is_logged[:, 3]  # channels of position and attitude
    if rows.sum() < 2 or not np.isfinite(residual[rows]).all():
        return None
    error = np.where(is_logged, residual, np.nan)[rows]
    pos_w, attitude_b, vel_w, rate_b = np.split(error[:, :12], 4, axis=1)
    # The attitude's error is the rotation axis times the sine of the angle. Two angles have that
    # sine; the integral of the rates' error along the axis decides which of them it is.
    row_s, sine = np.asarray(window.row_s)[rows], np.linalg.norm(attitude_b, axis=1)
    axis_b = -attitude_b / np.maximum(sine, 1e-12)[:, None]
    growth = np.nan_to_num(-(axis_b * rate_b).sum(axis=1))
    angle = np.arcsin(np.clip(sine, 0.0, 1.0))
    is_obtuse = np.cumsum(growth * np.gradient(row_s)) > np.pi / 2
    angle = np.where(is_obtuse, np.pi - angle, angle)
    row = take(window.row, rows)
    states = States(
        window.start_s + row_s,
        row.pos_w - pos_w,
        rot_to_quat(row.rot_w @ exp_rot(axis_b * angle[:, None])),
        row.vel_w - vel_w,
        row.rate_b - rate_b,
    )
    pos, vel, rate = (np.linalg.norm(part, axis=1) for part in (pos_w, vel_w, rate_b))
    return states, np.stack([pos, vel, np.rad2deg(angle), rate], axis=1)

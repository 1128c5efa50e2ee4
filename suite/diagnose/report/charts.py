"""Draws the charts of a diagnosis, and records held-out flights for rerun (rerun.io, a viewer)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eval.logs.flight_log import FlightLog
from eval.view.comparison import ComparedFlight, Simulation, States, write_comparison
from suite.common.charts import png, titled
from suite.diagnose.data.windows import FlightWindows, take
from suite.diagnose.estimate.permutation import CandidateScore
from suite.diagnose.sources.source import Series
from suite.diagnose.verdict.gap import Gap
from suite.diagnose.verdict.rollout_gap import Rollouts
from tracks.geometry.rotation import exp_rot, rot_to_quat

BEFORE, AFTER, WRONG, BOX = "#8b93a1", "#2463c9", "#e0892b", "#7a5cb8"
"""Colours: vehicle as given, with the named effects, with a wrong effect, with a black box."""
FLOOR = "#1d2430"
"""Colour of the noise floor and of measurements."""
OTHERS = "#c3c8d1"
"""Colour of candidates that were not named."""
SHOWN = 14
"""Largest number of candidates (effects that the search tried) in the chart."""


def gains_chart(
    scores: Sequence[CandidateScore], threshold: float | None, named: set[str]
) -> bytes:
    """Draw the gains of the best candidates as a PNG, and the gain that chance reaches.

    Args:
        scores: scores of all candidates, best first. A gain is the fall of the squared error.
        threshold: gain that the best of all candidates reaches by chance with 1 % probability.
        named: labels of the named effects.
    """
    shown = list(scores[:SHOWN])[::-1]
    figure = Figure(figsize=(8.2, 0.6 + 0.27 * len(shown)), layout="constrained")
    axes = figure.subplots()
    gains = np.maximum([s.gain for s in shown], 0.0)
    colours = [AFTER if s.candidate.label in named else OTHERS for s in shown]
    axes.barh(range(len(shown)), gains, color=colours, height=0.7)
    axes.set_yticks(range(len(shown)), [s.candidate.label for s in shown])
    if threshold is not None and threshold > 0.0:
        axes.axvline(threshold, color=WRONG, lw=1.5)
        axes.annotate(
            "chance, once in 100", (threshold, 0), xytext=(4, -2), textcoords="offset points",
            color=WRONG, fontsize=8,
        )  # fmt: skip
    axes.set_xscale("symlog", linthresh=10.0)
    axes.set_xlim(left=0.0)
    titled(axes, "Fall of the squared error on stretches left out [noise variances]")
    return png(figure)


def gap_chart(rows: Sequence[tuple[str, Gap, str]], speed: np.ndarray | None, seed: int) -> bytes:
    """Draw gaps with their intervals as a PNG, and next to them each rollout's error by its speed.

    Args:
        rows: label, gap and colour of each bar, from top to bottom.
        speed: (W,) speeds of the held-out rollouts at their starts [m/s]; None without rollouts.
        seed: seed of the intervals' draws.
    """
    figure = Figure(figsize=(11.0, 3.4 if speed is not None else 2.0), layout="constrained")
    left, *others = figure.subplots(1, 1 if speed is None else 2, squeeze=False)[0]
    bars = [(label, gap.rms, gap.ci95(seed), colour) for label, gap, colour in rows]
    _gap_bars(left, bars, rows[0][1].floor)
    titled(left, "Gap on held-out flights; the dotted line is the noise floor")
    if speed is None:
        return png(figure)
    (right,) = others
    for label, gap, colour in rows:
        if len(gap.score) == len(speed):
            right.plot(speed, np.sqrt(gap.score), "o", ms=3.5, color=colour, label=label)
    right.axhline(1.0, color=FLOOR, lw=0.8, ls=":")
    right.set_yscale("log")
    _few_ticks(right)
    right.set_xlabel("speed at the start [m/s]", fontsize=9)
    titled(right, "Each held-out rollout")
    return png(figure)


def black_box_chart(sides: Sequence[Mapping[str, Any]]) -> bytes:
    """Draw the gaps of named effects and black box as a PNG, for one or two comparisons.

    `sides` are entries of `black_box` in diagnosis.json.
    """
    figure = Figure(figsize=(11.0, 2.4), layout="constrained")
    for axes, side in zip(figure.subplots(1, 2), sides, strict=False):
        rows = [(label, gap["gap"], gap["ci95"], hue) for label, gap, hue in labelled_gaps(side)]
        _gap_bars(axes, rows, 1.0)
        titled(axes, f"Gap on {side['judged_on']}")
    for axes in figure.axes[len(sides) :]:
        axes.set_axis_off()
    return png(figure)


def labelled_gaps(side: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any], str]]:
    """Return label, gap and colour of each compared model, from top to bottom."""
    rows = [
        ("as given", side["before"], BEFORE),
        ("named effect", side["named"], AFTER),
        ("Delta Action Model", side["black_box"], BOX),
    ]
    return [row for row in rows if row[1] is not None]


def _gap_bars(
    axes: Axes, rows: Sequence[tuple[str, float, tuple[float, float], str]], floor: float
) -> None:
    """Draw gaps and the noise floor.

    `rows` are (label, gap, 95 % interval, colour), from top to bottom.
    """
    for place, (_, gap, ci95, colour) in enumerate(rows[::-1]):
        axes.plot(ci95, [place, place], color=colour, lw=2.5, solid_capstyle="butt")
        axes.plot(gap, place, "o", ms=7, color=colour)
    axes.set_yticks(range(len(rows)), [label for label, *_ in rows[::-1]])
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.axvline(floor, color=FLOOR, lw=0.8, ls=":")
    axes.set_xscale("log")
    highest = max(ci95[1] for _, _, ci95, _ in rows)
    axes.set_xlim(0.8 * floor, 1.25 * max(1.5 * floor, highest))
    _few_ticks(axes, "x")


def _few_ticks(axes: Axes, which: str = "y") -> None:
    """Label a logarithmic axis with plain numbers, and with fewer of them over a wide range."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())
    low, high = axis.get_view_interval()
    if high / max(low, 1e-9) > 300.0:
        axis.set_major_locator(LogLocator())


def series_chart(series: Series) -> bytes:
    """Draw a held-out stretch, measured and simulated, as a PNG."""
    figure = Figure(figsize=(9.0, 3.1), layout="constrained")
    axes = figure.subplots()
    axes.plot(series.time_s, series.measured, color=FLOOR, lw=1.6, label="measured")
    for (label, values), colour in zip(series.simulated.items(), (BEFORE, AFTER), strict=False):
        axes.plot(series.time_s, values, color=colour, lw=1.4, label=label)
    axes.set_xlabel("time [s]", fontsize=8)
    figure.legend(fontsize=8, frameon=False, ncols=3, loc="outside lower center")
    titled(axes, series.label)
    return png(figure)


def write_rollouts(path: Path, flown: Rollouts, fitted: np.ndarray | None) -> Path:
    """Write held-out flights, measured and simulated in rollouts of 1 s, as a recording (.rrd).

    Args:
        path: the file to write.
        flown: the flights and their rollouts.
        fitted: (P,) parameters with the named effects; None if nothing was named.

    Raises:
        OSError: if the file cannot be written; no partial file remains.
    """
    windows, simulated = flown.simulated(fitted)
    flights = []
    for number in np.unique(windows.flight):
        rows = np.flatnonzero(windows.flight == number)
        simulations = []
        for label, residual in simulated.items():
            rollouts = [_rollout(take(windows, row), residual[row]) for row in rows]
            paths, errors = [], []
            for states, error in filter(None, rollouts):  # without those that diverged
                paths.append(states)
                errors.append(error)
            simulations.append(Simulation(label, paths, errors))
        log = flown.logs[int(number)]
        flights.append(ComparedFlight(log.name, _measured(log, flown.since_s), simulations))
    return write_comparison(path, flights, flown.vehicle.body.half_size)


def _measured(log: FlightLog, first_s: float) -> States:
    """Return the measured state of a flight from `first_s` on."""
    time_s = log.time_s - log.time_s[0]
    rows = time_s >= first_s - 1e-6
    fields = (time_s, log.pos_w, log.quat_wxyz, log.vel_w, log.rate_b)
    return States(*(field[rows] for field in fields))


def _rollout(window: FlightWindows, residual: np.ndarray) -> tuple[States, np.ndarray] | None:
    """Return the simulated states and the errors of one rollout; None if it diverged.

    They are at its T rows with a measured pose. The errors (T, 4) are those of position [m],
    velocity [m/s], attitude [deg] and rates [rad/s]. `residual` is measured minus simulated.
    """
    is_logged = np.asarray(window.valid)
    rows = is_logged[:, 0] & is_logged[:, 3]  # channels of position and attitude
    if rows.sum() < 2 or not np.isfinite(residual[rows]).all():
        return None
    error = np.where(is_logged, residual, np.nan)[rows]
    pos_w, attitude_b, vel_w, rate_b = np.split(error[:, :12], 4, axis=1)
    # The attitude's error is the rotation axis times the sine of the angle.
    sine = np.linalg.norm(attitude_b, axis=1, keepdims=True)
    angle = np.arcsin(np.clip(sine, 0.0, 1.0))
    rotation_b = -attitude_b * angle / np.maximum(sine, 1e-12)
    states = States(
        window.start_s + np.asarray(window.row_s)[rows],
        np.asarray(window.row_pos_w)[rows] - pos_w,
        rot_to_quat(np.asarray(window.row_rot_w)[rows] @ exp_rot(rotation_b)),
        np.asarray(window.row_vel_w)[rows] - vel_w,
        np.asarray(window.row_rate_b)[rows] - rate_b,
    )
    pos, vel, rate = (np.linalg.norm(part, axis=1) for part in (pos_w, vel_w, rate_b))
    return states, np.stack([pos, vel, np.rad2deg(angle[:, 0]), rate], axis=1)

"""Charts of a diagnosis as PNG, and held-out flights as a recording for rerun."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eval.logs.flight_log import FlightLog
from eval.view.comparison import Compared, Simulation, Track, write_comparison
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
SHOWN = 14
"""Candidates in the chart."""


def gains_chart(
    scores: Sequence[CandidateScore], threshold: float | None, named: set[str]
) -> bytes:
    """Return a chart of the gains of the best candidates, and the gain that chance reaches.

    Args:
        scores: best first.
        threshold: gain that the best of all candidates reaches by chance once in a hundred.
        named: labels of what was named.
    """
    shown = list(scores[:SHOWN])[::-1]
    figure = Figure(figsize=(8.2, 0.6 + 0.27 * len(shown)), layout="constrained")
    axes = figure.subplots()
    gains = np.maximum([s.gain for s in shown], 0.0)
    colours = [AFTER if s.candidate.label in named else "#c3c8d1" for s in shown]
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
    """Return gaps with their intervals, and each rollout's error against its speed.

    Args:
        rows: label, gap and colour, from top to bottom.
        speed: (W,) of the held-out rollouts at their starts [m/s]; None where none was flown.
        seed: of the intervals' draws.
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
    """Return the gaps of the named effect and of the black box, for one or two comparisons.

    `sides` are those of the JSON.
    """
    figure = Figure(figsize=(11.0, 2.4), layout="constrained")
    for axes, side in zip(figure.subplots(1, 2), sides, strict=False):
        rows = [(label, one["gap"], one["ci95"], hue) for label, one, hue in labelled_gaps(side)]
        _gap_bars(axes, rows, 1.0)
        titled(axes, f"Gap on {side['judged_on']}")
    for axes in figure.axes[len(sides) :]:
        axes.set_axis_off()
    return png(figure)


def labelled_gaps(side: Mapping[str, Any]) -> list[tuple[str, Mapping[str, Any], str]]:
    """Return label, gap and colour of what is compared on a side, from top to bottom."""
    rows = [
        ("as given", side["before"], BEFORE),
        ("named effect", side["named"], AFTER),
        ("Delta Action Model", side["black_box"], BOX),
    ]
    return [row for row in rows if row[1] is not None]


def _gap_bars(
    axes: Axes, rows: Sequence[tuple[str, float, tuple[float, float], str]], floor: float
) -> None:
    """Draw gaps (label, gap, 95 % interval, colour) from top to bottom, and the noise floor."""
    for place, (_, gap, between, colour) in enumerate(rows[::-1]):
        axes.plot(between, [place, place], color=colour, lw=2.5, solid_capstyle="butt")
        axes.plot(gap, place, "o", ms=7, color=colour)
    axes.set_yticks(range(len(rows)), [label for label, *_ in rows[::-1]])
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.axvline(floor, color=FLOOR, lw=0.8, ls=":")
    axes.set_xscale("log")
    most = max(between[1] for _, _, between, _ in rows)
    axes.set_xlim(0.8 * floor, 1.25 * max(1.5 * floor, most))
    _few_ticks(axes, "x")


def _few_ticks(axes: Axes, which: str = "y") -> None:
    """Label a logarithmic axis with plain numbers."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())
    low, high = axis.get_view_interval()
    if high / max(low, 1e-9) > 300.0:
        axis.set_major_locator(LogLocator())


def series_chart(series: Series) -> bytes:
    """Return a held-out stretch as measured and as simulated."""
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
    """Write rollouts of 1 s over what was held out, as given and as `fitted` (P,), as `.rrd`.

    Raises:
        OSError: where the file cannot be written; nothing is left under its name.
    """
    windows, simulated = flown.simulated(fitted)
    flights = []
    for number in np.unique(windows.flight):
        rows = np.flatnonzero(windows.flight == number)
        simulations = []
        for label, residual in simulated.items():
            found = [_rollout(take(windows, row), residual[row]) for row in rows]
            whole = [one for one in found if one is not None]
            tracks, errors = [one[0] for one in whole], [one[1] for one in whole]
            simulations.append(Simulation(label, tracks, errors))
        log = flown.logs[int(number)]
        flights.append(Compared(log.name, _measured(log, flown.since_s), simulations))
    return write_comparison(path, flights, flown.vehicle.body.half_size)


def _measured(log: FlightLog, first_s: float) -> Track:
    time_s = log.time_s - log.time_s[0]
    rows = time_s >= first_s - 1e-6
    fields = (time_s, log.pos_w, log.quat_wxyz, log.vel_w, log.rate_b)
    return Track(*(field[rows] for field in fields))


def _rollout(window: FlightWindows, residual: np.ndarray) -> tuple[Track, np.ndarray] | None:
    """Return one rollout and its errors (T, 4) at the rows with a pose; None where it diverged."""
    seen = np.asarray(window.seen)
    rows = seen[:, 0] & seen[:, 3]
    if rows.sum() < 2 or not np.isfinite(residual[rows]).all():
        return None
    error = np.where(seen, residual, np.nan)[rows]
    sine = np.linalg.norm(error[:, 3:6], axis=1, keepdims=True)
    angle = np.arcsin(np.clip(sine, 0.0, 1.0))
    # The attitude's error is the sine of the angle that is left to what was measured.
    turn = -error[:, 3:6] * angle / np.maximum(sine, 1e-12)
    rot_w = np.asarray(window.row_rot_w)[rows] @ exp_rot(turn)
    track = Track(
        window.start_s + np.asarray(window.row_s)[rows],
        np.asarray(window.row_pos_w)[rows] - error[:, :3],
        rot_to_quat(rot_w),
        np.asarray(window.row_vel_w)[rows] - error[:, 6:9],
        np.asarray(window.row_rate_b)[rows] - error[:, 9:12],
    )
    lengths = [np.linalg.norm(error[:, at], axis=1) for at in (slice(0, 3), slice(6, 9))]
    errors = np.stack(
        [*lengths, np.rad2deg(angle[:, 0]), np.linalg.norm(error[:, 9:12], axis=1)], axis=1
    )
    return track, errors

"""Charts of a diagnosis as PNG, and held-out flights as a recording for rerun."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from eval.logs.flight_log import FlightLog
from eval.view.comparison import Compared, Simulation, Track, write_comparison
from suite.common.charts import png, titled
from suite.diagnose.data.windows import LENGTH_S, SLICES, UNITS, FlightWindows, take
from suite.diagnose.estimate.permutation import CandidateScore
from suite.diagnose.search.look import rollouts_of
from suite.diagnose.verdict.black_box import BlackBoxComparison
from suite.diagnose.verdict.diagnosis import Diagnosis
from suite.diagnose.verdict.gap import Gap, true_starts
from tracks.geometry.rotation import exp_rot, rot_to_quat

BEFORE, AFTER, WRONG, BOX = "#8b93a1", "#2463c9", "#e0892b", "#7a5cb8"
"""Colours of the vehicle as given, with what was named, with a wrong name, with a black box."""
FLOOR = "#1d2430"
SHOWN = 14
"""Candidates in the chart."""


def gains_chart(
    scores: Sequence[CandidateScore], threshold: float | None, named: set[str]
) -> bytes:
    """Return the gains of the best candidates, and what chance reaches.

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


def gap_chart(rows: Sequence[tuple[str, Gap, str]], speed: np.ndarray, seed: int) -> bytes:
    """Return gaps with their intervals, and each rollout's error against its speed.

    Args:
        rows: label, gap and colour, from top to bottom.
        speed: (W,) of the held-out rollouts at their starts [m/s].
        seed: of the intervals' draws.
    """
    figure = Figure(figsize=(11.0, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    _gap_bars(left, rows, seed)
    titled(left, "Gap on held-out flights, 1 is the noise floor")
    for label, gap, colour in rows:
        if len(gap.score) == len(speed):
            right.plot(speed, np.sqrt(gap.score), "o", ms=3.5, color=colour, label=label)
    right.axhline(1.0, color=FLOOR, lw=0.8, ls=":")
    right.set_yscale("log")
    _few_ticks(right)
    right.set_xlabel("speed at the start [m/s]", fontsize=9)
    titled(right, "Each held-out rollout")
    return png(figure)


def black_box_chart(sides: Sequence[BlackBoxComparison], seed: int) -> bytes:
    """Return the gaps of the named effect and of the black box, for one or two comparisons."""
    figure = Figure(figsize=(11.0, 2.4), layout="constrained")
    for axes, side in zip(figure.subplots(1, 2), sides, strict=False):
        colours = (BEFORE, AFTER, BOX)
        rows = [(*row, colour) for row, colour in zip(labelled_gaps(side), colours, strict=True)]
        _gap_bars(axes, [(label, gap, colour) for label, gap, colour in rows if gap], seed)
        titled(axes, f"Gap on {side.judged_on}")
    for axes in figure.axes[len(sides) :]:
        axes.set_axis_off()
    return png(figure)


def labelled_gaps(side: BlackBoxComparison) -> list[tuple[str, Gap | None]]:
    """Return what is compared, from top to bottom."""
    return [
        ("as given", side.before),
        ("named effect", side.named),
        ("Delta Action Model", side.black_box),
    ]


def _gap_bars(axes: Axes, rows: Sequence[tuple[str, Gap, str]], seed: int) -> None:
    """Draw gaps (label, gap, colour) with their 95 % intervals, from top to bottom."""
    for place, (_, gap, colour) in enumerate(rows[::-1]):
        low, high = gap.ci95(seed)
        axes.plot([low, high], [place, place], color=colour, lw=2.5, solid_capstyle="butt")
        axes.plot(gap.rms, place, "o", ms=7, color=colour)
    axes.set_yticks(range(len(rows)), [label for label, _, _ in rows[::-1]])
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.axvline(1.0, color=FLOOR, lw=0.8, ls=":")
    axes.set_xscale("log")
    axes.set_xlim(0.8, 1.25 * max(1.5, *(gap.ci95(seed)[1] for _, gap, _ in rows)))
    _few_ticks(axes, "x")


def _few_ticks(axes: Axes, which: str = "y") -> None:
    """Write numbers as people do on a logarithmic axis."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(NullFormatter())
    low, high = axis.get_view_interval()
    if high / max(low, 1e-9) > 300.0:
        axis.set_major_locator(LogLocator())


MOST = 4
"""Held-out flights in a recording."""


def held_out_rollouts(diagnosis: Diagnosis) -> tuple[FlightWindows, dict[str, np.ndarray]]:
    """Return windows of 1 s over what was held out, and measured - simulated (W, N, 19) in them.

    As given and, where something was named, with it, by what it is called.
    """
    model, held = diagnosis.model, diagnosis.held_windows
    windows = diagnosis.cut(LENGTH_S, np.unique(held.flight)[:MOST].tolist())
    windows = take(windows, np.asarray(windows.start_s) >= _first_s(diagnosis) - 1e-6)
    series = {"simulated as given": diagnosis.start}
    if diagnosis.fitted is not None:
        series["simulated with what was named"] = diagnosis.fitted
    return windows, {
        label: model.residual(theta, true_starts(model, theta, windows), windows)
        for label, theta in series.items()
    }


def _first_s(diagnosis: Diagnosis) -> float:
    """Return from when on a flight was held out [s]."""
    fitted, held = rollouts_of(diagnosis.search.last).windows, diagnosis.held_windows
    lone = bool(np.isin(held.flight, fitted.flight).any())
    return float(np.min(held.start_s)) if lone else 0.0


def held_out_chart(
    windows: FlightWindows, simulated: Mapping[str, np.ndarray], sigma: np.ndarray
) -> bytes:
    """Return a held-out flight as measured and as simulated, where the model misses most.

    Args:
        windows: from `held_out_rollouts`, and `simulated`.
        simulated: measured - simulated by label.
        sigma: (19,) noise of the channels.
    """
    measured = {
        "position": windows.row_pos_w, "velocity": windows.row_vel_w, "rates": windows.row_rate_b
    }  # fmt: skip
    of = np.asarray(windows.flight) == windows.flight[0]
    seen = np.asarray(windows.seen)[of]
    first = next(iter(simulated.values()))[of]

    def missed(group: str, axis: int) -> float:
        at = SLICES[group].start + axis
        there = seen[..., at] & np.isfinite(first[..., at])
        return float(np.sqrt((first[..., at][there] ** 2).mean()) / sigma[at]) if there.any() else 0

    group, axis = max(((g, k) for g in measured for k in range(3)), key=lambda one: missed(*one))
    at = SLICES[group].start + axis
    time_s = (np.asarray(windows.start_s)[:, None] + np.asarray(windows.row_s))[of]
    value = np.where(seen[..., at], np.asarray(measured[group])[of][..., axis], np.nan)
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    axes = figure.subplots()
    axes.plot(time_s.ravel(), value.ravel(), color=FLOOR, lw=1.6, label="measured")
    for (label, residual), colour in zip(simulated.items(), (BEFORE, AFTER), strict=False):
        for row, line in enumerate(value - residual[of][..., at]):
            axes.plot(time_s[row], line, color=colour, lw=1.4, label="" if row else label)
    axes.set_xlabel("time [s]", fontsize=8)
    axes.legend(fontsize=8, frameon=False, ncols=3)
    frame = "body" if group == "rates" else "world"
    titled(axes, f"{group.capitalize()} along {frame} {'xyz'[axis]} [{UNITS[group]}]")
    return png(figure)


def write_rollouts(path: Path, diagnosis: Diagnosis) -> Path:
    """Write rollouts of 1 s over what was held out, as given and with what was named, as `.rrd`.

    Raises:
        OSError: where the file cannot be written; nothing is left under its name.
    """
    windows, simulated = held_out_rollouts(diagnosis)
    first_s, flights = _first_s(diagnosis), []
    for number in np.unique(windows.flight):
        rows = np.flatnonzero(windows.flight == number)
        simulations = []
        for label, residual in simulated.items():
            found = [_rollout(take(windows, row), residual[row]) for row in rows]
            whole = [one for one in found if one is not None]
            tracks, errors = [one[0] for one in whole], [one[1] for one in whole]
            simulations.append(Simulation(label, tracks, errors))
        log = diagnosis.logs[int(number)]
        flights.append(Compared(log.name, _measured(log, first_s), simulations))
    return write_comparison(path, flights, diagnosis.nominal.body.half_size)


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

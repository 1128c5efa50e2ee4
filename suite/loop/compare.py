"""Three policies on the same trials: before, fine-tuned without and with Delta Action Model.

Fine-tuning without it costs the same training, so what more training alone brings is not taken for
the model's merit: the difference that counts is `with` minus `without`.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from eval.judging.statistics import (
    Interval,
    bootstrap_mean,
    bootstrap_median,
    paired_bootstrap,
    paired_success,
    wilson,
)
from eval.worlds.trial import TrialResult
from suite.common.report import Cell, Grid

BEFORE, WITHOUT, WITH = "before", "without", "with"
VARIANTS = (BEFORE, WITHOUT, WITH)
"""The policies that are compared, in the order of the tables."""
OVERALL = "all"
"""What the line over all cells has for a track."""
CAVEAT = (
    "Intervals are 95 % over trials, for these three policies: another training seed gives other "
    "policies. The cells' intervals are not corrected for there being several."
)
"""What the intervals do not say."""


class Measure(NamedTuple):
    """One number of the three policies on the same trials."""

    before: Interval
    without: Interval
    """Fine-tuned without the Delta Action Model, for as many iterations."""
    with_delta: Interval
    with_minus_without: Interval
    """On the same trials, trial by trial."""
    with_minus_before: Interval


class Line(NamedTuple):
    """What the trials on one track at one level come to, or all of them."""

    track: str
    difficulty: int | None
    """None over all cells."""
    trials: int
    """Of each policy."""
    success: Measure
    """Rates, Wilson; differences by Newcombe's paired interval."""
    p_value: float
    """With against without, exact McNemar test, two-sided."""
    gates: Measure
    """Mean number of gates passed, bootstrap."""
    v_mean: Measure
    """Median over trials [m/s], bootstrap; the difference is the median of the pairs'."""
    v_max: Measure
    """As v_mean [m/s]."""


def compare(results: Mapping[str, Sequence[TrialResult]]) -> list[Line]:
    """Return a line for every track and level, and as the last one that over all of them.

    Args:
        results: of each of `VARIANTS`, on the same trials in the same order.

    Raises:
        ValueError: where the trials are not the same.
    """
    trials = [row.trial for row in results[BEFORE]]
    for variant in VARIANTS:
        if [row.trial for row in results[variant]] != trials:
            raise ValueError(f"{variant!r} and {BEFORE!r} were not flown on the same trials")
    cells = list(dict.fromkeys((trial.track, trial.difficulty) for trial in trials))
    lines = []
    for track, level in cells:
        chosen = [k for k, trial in enumerate(trials) if trial[:2] == (track, level)]
        rows = {name: [results[name][k] for k in chosen] for name in VARIANTS}
        lines.append(_line(track, level, rows))
    return [*lines, _line(OVERALL, None, results)]


def _line(track: str, level: int | None, rows: Mapping[str, Sequence[TrialResult]]) -> Line:
    seed = zlib.crc32(repr((track, level)).encode())

    def column(field: str) -> dict[str, np.ndarray]:
        return {name: np.array([getattr(row, field) for row in rows[name]]) for name in VARIANTS}

    def measure(
        field: str,
        alone: Callable[[np.ndarray], Interval],
        apart: Callable[[np.ndarray, np.ndarray], Interval],
    ) -> Measure:
        of = column(field)
        before, without, with_delta = (of[name] for name in VARIANTS)
        return Measure(
            alone(before),
            alone(without),
            alone(with_delta),
            apart(with_delta, without),
            apart(with_delta, before),
        )

    def rate(won: np.ndarray) -> Interval:
        return wilson(int(won.sum()), len(won))

    def rates_apart(one: np.ndarray, two: np.ndarray) -> Interval:
        return Interval(*paired_success(one, two)[:3])

    def mean(values: np.ndarray) -> Interval:
        return bootstrap_mean(values, seed)

    def median(values: np.ndarray) -> Interval:
        return bootstrap_median(values, seed)

    def medians_apart(one: np.ndarray, two: np.ndarray) -> Interval:
        return paired_bootstrap(one, two, seed)

    won = column("success")
    return Line(
        track,
        level,
        trials=len(rows[BEFORE]),
        success=measure("success", rate, rates_apart),
        p_value=paired_success(won[WITH], won[WITHOUT]).p_value,
        gates=measure("gates_passed", mean, lambda one, two: mean(one - two)),
        v_mean=measure("v_mean", median, medians_apart),
        v_max=measure("v_max", median, medians_apart),
    )


def grids(lines: Sequence[Line]) -> list[Grid]:
    """Return the comparison as tables: success, gates, mean speed, largest speed."""
    return [
        _grid("Success, all gates without a collision [%]", lines, "success", 100, 0),
        _grid("Gates passed, mean", lines, "gates", 1, 2),
        _grid("Mean speed of a trial, median [m/s]", lines, "v_mean", 1, 2),
        _grid("Largest speed of a trial, median [m/s]", lines, "v_max", 1, 2),
    ]


def _grid(title: str, lines: Sequence[Line], field: str, scale: float, digits: int) -> Grid:
    test = field == "success"
    headers = ["track", "level", "trials", "before", "tuned without delta", "tuned with delta"]
    headers += ["with - without", *(["p (McNemar)"] if test else []), "with - before"]
    rows = []
    for line in lines:
        measure: Measure = getattr(line, field)
        level = "all" if line.difficulty is None else str(line.difficulty)
        merit, gain = (difference_cell(d, scale, digits) for d in measure[3:])
        rows.append(
            [
                *(Cell(text) for text in (line.track, level, str(line.trials))),
                *(Cell(value_text(interval, scale, digits)) for interval in measure[:3]),
                merit,
                *([Cell(f"{line.p_value:.2g}")] if test else []),
                gain,
            ]
        )
    return Grid(title, headers, rows, strong_last=True)


def value_text(interval: Interval, scale: float, digits: int) -> str:
    """Return a number with its interval for a table."""
    value, low, high = (f"{scale * x:.{digits}f}" for x in interval)
    return f"{value} [{low}, {high}]"


def difference_cell(interval: Interval, scale: float, digits: int) -> Cell:
    """Return a difference with its interval and sign, toned where it does not hold zero."""
    # Adding zero to what is rounded turns -0, which reads as if something had been lost, into +0.
    value, low, high = (f"{round(scale * x, digits) + 0.0:+.{digits}f}" for x in interval)
    tone = "good" if interval.low > 0 else "bad" if interval.high < 0 else ""
    return Cell(f"{value} [{low}, {high}]", tone)


def verdict(overall: Line) -> str:
    """Return in one sentence what fine-tuning under the Delta Action Model changed."""
    success = overall.success
    value, low, high = (100 * x for x in success.with_minus_without)
    if low > 0:
        words = "more than the same fine-tuning without it"
    elif high < 0:
        words = "fewer than the same fine-tuning without it"
    else:
        words = "not to be told from the same fine-tuning without it"
    return (
        f"Fine-tuned with the Delta Action Model, {100 * success.with_delta.value:.0f} % of "
        f"{overall.trials} trials succeed: {words} ({100 * success.without.value:.0f} %; "
        f"difference {value:+.0f} points [{low:+.0f}, {high:+.0f}]); before, "
        f"{100 * success.before.value:.0f} %."
    )

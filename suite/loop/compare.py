"""Three policies on the same trials: before, fine-tuned without and with Delta Action Model.

Fine-tuning without the model has the same number of gradient steps and is the control: the effect
of the model is `with` minus `without`.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from eval.judging.statistics import (
    Interval,
    PairedDifference,
    bootstrap_mean,
    bootstrap_median,
    paired_bootstrap,
    paired_success,
    wilson,
)
from eval.worlds.trial import TrialResult, TrialSpec
from tracks.common.grid import Cell, Grid, table

BEFORE, WITHOUT, WITH = "before", "without", "with"
VARIANTS = (BEFORE, WITHOUT, WITH)
"""The compared policies, in the order of the tables."""
OVERALL = "all"
"""Name of the line over all cells, in place of a track."""
CAVEAT = (
    "Intervals are 95 % over trials, for these three policies: another training seed gives other "
    "policies. The cells' intervals are not corrected for there being several."
)
"""Note below the tables on the intervals."""


class Measure(NamedTuple):
    """A quantity of the three policies on the same trials."""

    before: Interval
    without: Interval
    """Fine-tuned without the Delta Action Model, with the same number of gradient steps."""
    with_delta: Interval
    with_minus_without: Interval
    """On the same trials, trial by trial."""
    with_minus_before: Interval


class Line(NamedTuple):
    """Results of the trials on one track at one level, or of all trials."""

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
    """Return a line for every track and level, and one for all trials at the end.

    Args:
        results: of each of `VARIANTS`, on the same trials in the same order.

    Raises:
        ValueError: if the trials differ.
    """
    trials = same_trials({name: results[name] for name in VARIANTS})
    lines = []
    for track, level in dict.fromkeys(trial[:2] for trial in trials):
        chosen = [k for k, trial in enumerate(trials) if trial[:2] == (track, level)]
        rows = {name: [results[name][k] for k in chosen] for name in VARIANTS}
        lines.append(_line(track, level, rows))
    return [*lines, _line(OVERALL, None, results)]


def same_trials(results: Mapping[str, Sequence[TrialResult]]) -> list[TrialSpec]:
    """Return the common trials of all policies, in order.

    Raises:
        ValueError: if the trials differ.
    """
    first, *others = results
    trials = [row.trial for row in results[first]]
    for name in others:
        if [row.trial for row in results[name]] != trials:
            raise ValueError(f"{name!r} and {first!r} were not flown on the same trials")
    return trials


def rate(won: np.ndarray) -> Interval:
    """Return the share of true values with Wilson's interval."""
    return wilson(int(won.sum()), len(won))


def _line(track: str, level: int | None, rows: Mapping[str, Sequence[TrialResult]]) -> Line:
    seed = zlib.crc32(repr((track, level)).encode())
    mean, median = partial(bootstrap_mean, seed=seed), partial(bootstrap_median, seed=seed)

    def columns(field: str) -> list[np.ndarray]:
        return [np.array([getattr(row, field) for row in rows[name]]) for name in VARIANTS]

    def measure(
        field: str,
        alone: Callable[[np.ndarray], Interval],
        apart: Callable[[np.ndarray, np.ndarray], Interval],
    ) -> Measure:
        before, without, with_delta = columns(field)
        return Measure(
            before=alone(before),
            without=alone(without),
            with_delta=alone(with_delta),
            with_minus_without=apart(with_delta, without),
            with_minus_before=apart(with_delta, before),
        )

    medians_apart = partial(paired_bootstrap, seed=seed)
    _, without, with_delta = columns("success")
    return Line(
        track,
        level,
        trials=len(rows[BEFORE]),
        success=measure("success", rate, lambda *pair: Interval(*paired_success(*pair)[:3])),
        p_value=paired_success(with_delta, without).p_value,
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
        to_control, to_before = (difference_cell(d, scale, digits) for d in measure[3:])
        alone = [value_text(interval, scale, digits) for interval in measure[:3]]
        p_value = [f"{line.p_value:.2g}"] if test else []
        rows.append([line.track, level, str(line.trials), *alone, to_control, *p_value, to_before])
    return table(headers, rows, title, strong_last=True)


def value_text(interval: Interval, scale: float, digits: int) -> str:
    """Return a number with its interval for a table."""
    value, low, high = (f"{scale * x:.{digits}f}" for x in interval)
    return f"{value} [{low}, {high}]"


def difference_cell(
    interval: Interval | PairedDifference, scale: float = 100, digits: int = 0
) -> Cell:
    """Return a difference with its interval and sign, coloured if it excludes zero.

    By default it is one of rates, in percentage points.
    """
    # Adding zero turns a rounded -0 into +0.
    value, low, high = (f"{round(scale * x, digits) + 0.0:+.{digits}f}" for x in interval[:3])
    tone = "good" if interval.low > 0 else "bad" if interval.high < 0 else ""
    return Cell(f"{value} [{low}, {high}]", tone)


def significance(difference: Interval) -> str:
    """Return a text on whether one policy succeeds significantly more often than another."""
    if difference.low > 0:
        return "more than"
    return "fewer than" if difference.high < 0 else "not significantly different from"


def points(difference: Interval) -> str:
    """Return a difference of success rates with its interval, in percentage points."""
    value, interval = difference_cell(difference).text.split(" ", 1)
    return f"{value} points {interval}"


def verdict(overall: Line) -> str:
    """Return a sentence on the effect of fine-tuning under the Delta Action Model."""
    success = overall.success
    return (
        f"Fine-tuned with the Delta Action Model, {100 * success.with_delta.value:.0f} % of "
        f"{overall.trials} trials succeed: {significance(success.with_minus_without)} the same "
        f"fine-tuning without it ({100 * success.without.value:.0f} %; "
        f"difference {points(success.with_minus_without)}); before, "
        f"{100 * success.before.value:.0f} %."
    )

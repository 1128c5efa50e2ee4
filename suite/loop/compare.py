"""Compare policies that a loop judged on the same trials: rates, speeds and their differences.

A trial is one judged flight: a track, its level (difficulty 0 to 9) and a seed; the trials of one
track and level are a cell. `compare` has a row per cell, for the three policies of the loop with a
Delta Action Model: before, fine-tuned without the model, and fine-tuned with it. Fine-tuning
without the model has the same number of gradient steps and is the control. `policy_results` has a
row per policy, for any number of them.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
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
from eval.worlds.trial import TrialResult, TrialSpec

BEFORE, WITHOUT, WITH = "before", "without", "with"
VARIANTS = (BEFORE, WITHOUT, WITH)
"""The policies that `compare` compares, in the order of the tables."""
OVERALL = "all"
"""Name of the row over all cells, in place of a track."""


class Measure(NamedTuple):
    """A quantity of the three policies on the same trials."""

    before: Interval
    without: Interval
    """Fine-tuned without the Delta Action Model, with the same number of gradient steps."""
    with_delta: Interval
    """Fine-tuned with the Delta Action Model."""
    with_minus_without: Interval
    """Paired by trial."""
    with_minus_before: Interval
    """Paired by trial."""


class CellComparison(NamedTuple):
    """Results of the trials on one track at one level, or of all trials."""

    track: str
    difficulty: int | None
    """None over all cells."""
    trials: int
    """Number of trials of each policy."""
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


class Difference(NamedTuple):
    """One policy's success minus another's on the same trials."""

    against: str
    """The other's name."""
    success: Interval
    """Newcombe's paired interval."""
    p_value: float
    """Exact McNemar test, two-sided."""


class PolicyResult(NamedTuple):
    """The results of one policy."""

    name: str
    success: Interval
    """Rate, Wilson."""
    by_cell: dict[str, Interval]
    """The same on every track and level, as "zigzag 3"."""
    gates: Interval
    """Mean number of gates passed, bootstrap."""
    v_mean: Interval
    """Median over trials [m/s], bootstrap."""
    differences: list[Difference]
    """Against each other reference."""


def compare(results: Mapping[str, Sequence[TrialResult]]) -> list[CellComparison]:
    """Return a row for every track and level, and one for all trials at the end.

    Args:
        results: of each of `VARIANTS`, on the same trials in the same order.

    Raises:
        ValueError: if the trials differ.
    """
    trials = same_trials({name: results[name] for name in VARIANTS})
    rows = []
    for (track, level), indices in _cells(trials).items():
        in_cell = {name: [results[name][k] for k in indices] for name in VARIANTS}
        rows.append(_compare_cell(track, level, in_cell))
    return [*rows, _compare_cell(OVERALL, None, results)]


def policy_results(
    results: Mapping[str, Sequence[TrialResult]], references: Sequence[str]
) -> list[PolicyResult]:
    """Return the results of every policy, in the order of `results`.

    Args:
        results: by policy, of the same trials in the same order.
        references: policies that the others are compared with.

    Raises:
        ValueError: if the trials differ.
    """
    cells = _cells(same_trials(results))
    successes = {name: np.array([row.success for row in rows]) for name, rows in results.items()}
    summaries = []
    for name, rows in results.items():
        seed, success = zlib.crc32(name.encode()), successes[name]
        pairs = {
            reference: paired_success(success, successes[reference])
            for reference in references
            if reference != name
        }
        summaries.append(
            PolicyResult(
                name=name,
                success=success_rate(success),
                by_cell={
                    f"{track} {level}": success_rate(success[indices])
                    for (track, level), indices in cells.items()
                },
                gates=bootstrap_mean(np.array([row.gates_passed for row in rows]), seed),
                v_mean=bootstrap_median(np.array([row.v_mean for row in rows]), seed),
                differences=[
                    Difference(reference, Interval(*pair[:3]), pair.p_value)
                    for reference, pair in pairs.items()
                ],
            )
        )
    return summaries


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


def success_rate(success: np.ndarray) -> Interval:
    """Return the share of true values with Wilson's interval."""
    return wilson(int(success.sum()), len(success))


def _cells(trials: Sequence[TrialSpec]) -> dict[tuple[str, int], list[int]]:
    """Return the indices of the trials on each track and level."""
    cells: dict[tuple[str, int], list[int]] = {}
    for index, trial in enumerate(trials):
        cells.setdefault((trial.track, trial.difficulty), []).append(index)
    return cells


def _compare_cell(
    track: str, level: int | None, rows: Mapping[str, Sequence[TrialResult]]
) -> CellComparison:
    """Return the comparison of the three policies on the trials of `rows`."""
    seed = zlib.crc32(repr((track, level)).encode())
    mean, median = partial(bootstrap_mean, seed=seed), partial(bootstrap_median, seed=seed)
    median_difference = partial(paired_bootstrap, seed=seed)

    def columns(field: str) -> list[np.ndarray]:
        return [np.array([getattr(row, field) for row in rows[name]]) for name in VARIANTS]

    def measure(
        field: str,
        interval: Callable[[np.ndarray], Interval],
        difference: Callable[[np.ndarray, np.ndarray], Interval],
    ) -> Measure:
        before, without, with_delta = columns(field)
        return Measure(
            before=interval(before),
            without=interval(without),
            with_delta=interval(with_delta),
            with_minus_without=difference(with_delta, without),
            with_minus_before=difference(with_delta, before),
        )

    _, without, with_delta = columns("success")
    return CellComparison(
        track,
        level,
        trials=len(rows[BEFORE]),
        success=measure(
            "success", success_rate, lambda *pair: Interval(*paired_success(*pair)[:3])
        ),
        p_value=paired_success(with_delta, without).p_value,
        gates=measure("gates_passed", mean, lambda a, b: mean(a - b)),
        v_mean=measure("v_mean", median, median_difference),
        v_max=measure("v_max", median, median_difference),
    )

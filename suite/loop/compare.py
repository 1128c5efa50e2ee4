"""Compare policies that a loop judged on the same trials: rates, speeds and their differences.

A trial is one judged flight: a track, its level (difficulty 0 to 9) and a seed. The trials of one
track and level are a cell.

`compare` returns a row per cell, for the three policies of the loop with a Delta Action Model (a
network that corrects actions): before fine-tuning, fine-tuned without the model, and fine-tuned
with it. The fine-tuning without the model has the same number of gradient steps; it is the control.
`policy_results` returns a row per policy, for any number of policies.

A p-value is that of the exact two-sided McNemar test, which compares the successes on equal trials.
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
    """A quantity, such as the success rate, of the three policies on the same trials."""

    before: Interval
    """Value of the policy before fine-tuning, with its interval."""
    without: Interval
    """Value of the policy fine-tuned without the Delta Action Model, the control."""
    with_delta: Interval
    """Value of the policy fine-tuned with the Delta Action Model."""
    with_minus_without: Interval
    """Difference of these two policies, paired by trial."""
    with_minus_before: Interval
    """Difference of the policies with the model and before fine-tuning, paired by trial."""


class CellComparison(NamedTuple):
    """Results of the trials on one track at one level, or of all trials."""

    track: str
    difficulty: int | None
    """Level of the track; None in the row over all trials."""
    trials: int
    """Number of trials of each policy."""
    success: Measure
    """Success rates with Wilson's intervals; their differences have Newcombe's paired intervals."""
    p_value: float
    """p-value of the difference with and without the Delta Action Model."""
    gates: Measure
    """Mean number of passed gates, with bootstrap intervals."""
    v_mean: Measure
    """Median over trials of the mean speed, with bootstrap intervals [m/s]. A difference is the
    median of the differences on equal trials."""
    v_max: Measure
    """Median over trials of the largest speed, as `v_mean` [m/s]."""


class Difference(NamedTuple):
    """Difference of the success rates of two policies on the same trials."""

    against: str
    """Name of the policy whose rate is subtracted."""
    success: Interval
    """The difference with Newcombe's paired interval."""
    p_value: float
    """p-value of the difference."""


class PolicyResult(NamedTuple):
    """The results of one policy."""

    name: str
    success: Interval
    """Success rate over all trials, with Wilson's interval."""
    by_cell: dict[str, Interval]
    """Success rate in each cell, by track and level such as "zigzag 3"."""
    gates: Interval
    """Mean number of passed gates, with a bootstrap interval."""
    v_mean: Interval
    """Median over trials of the mean speed, with a bootstrap interval [m/s]."""
    differences: list[Difference]
    """Differences to each reference policy, without the policy itself."""


def compare(results: Mapping[str, Sequence[TrialResult]]) -> list[CellComparison]:
    """Return a row for every track and level, and one for all trials at the end.

    Args:
        results: results of each of the `VARIANTS`, on the same trials in the same order.

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
        results: results of each policy, on the same trials in the same order.
        references: names of the policies with which the others are compared.

    Raises:
        ValueError: if the trials differ.
    """
    cells = _cells(same_trials(results))
    successes = {name: np.array([row.success for row in rows]) for name, rows in results.items()}
    summaries = []
    for name, rows in results.items():
        # The seed of the bootstrap: the same numbers on every machine.
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
    """Return the indices of the trials in each cell, by track and level."""
    cells: dict[tuple[str, int], list[int]] = {}
    for index, trial in enumerate(trials):
        cells.setdefault((trial.track, trial.difficulty), []).append(index)
    return cells


def _compare_cell(
    track: str, level: int | None, rows: Mapping[str, Sequence[TrialResult]]
) -> CellComparison:
    """Return the comparison of the three policies on the trials of `rows` (results by policy)."""
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
        success=measure("success", success_rate, lambda a, b: Interval(*paired_success(a, b)[:3])),
        p_value=paired_success(with_delta, without).p_value,
        gates=measure("gates_passed", mean, lambda a, b: mean(a - b)),
        v_mean=measure("v_mean", median, median_difference),
        v_max=measure("v_max", median, median_difference),
    )

"""Compare the policies that a loop judged on the same trials: rates, speeds and differences.

A trial is one judged flight: a track, its level (difficulty 0 to 9) and a seed. The trials of one
track and level are a cell.

A p-value is that of the exact two-sided McNemar test, which compares the successes on equal trials.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from eval.judging.statistics import Interval, bootstrap, paired_success, wilson
from eval.worlds.trial import TrialResult, TrialSpec

BEFORE = "before"
"""Name of the policy before fine-tuning, which every loop has."""


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


def policy_results(
    results: Mapping[str, Sequence[TrialResult]], references: Sequence[str]
) -> list[PolicyResult]:
    """Return the results of every policy, in the order of `results`.

    All policies have the same trials in the same order. The others are compared with the
    `references`.

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
                gates=bootstrap(np.array([row.gates_passed for row in rows]), seed, np.mean),
                v_mean=bootstrap(np.array([row.v_mean for row in rows]), seed),
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

"""Comparison of evaluations on the same trials; evaluations on different trials are refused.

`suite eval` with several policies flies all of them on the same trials. This module compares
evaluations that were run separately, and several training seeds of one method.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eval.judging.results import read_trials
from eval.judging.statistics import Interval, over_seeds, paired_success, wilson
from eval.worlds.trial import TrialResult, TrialSpec
from tracks.input.reading import read_json

CONDITIONS = ("world", "time_limit_s", "deadline_s")
"""Settings that affect the outcome of a trial, besides the trial itself and the input files."""


class Run(NamedTuple):
    """One policy of one evaluation."""

    name: str
    """Label in messages: the folder, and the policy if the folder holds several."""
    rows: dict[TrialSpec, TrialResult]
    """The result of each trial."""
    conditions: dict[str, Any]
    """Settings and input files that must be the same for a comparison."""


def read_runs(folder: Path) -> list[Run]:
    """Return one run for each policy in an evaluation's folder.

    Raises:
        ValueError: if the folder has no evaluation, or files that `suite eval` did not write.
    """
    path = folder / "trials.parquet"
    if not path.is_file():
        raise ValueError(f"{folder}: holds no trials.parquet; give the --out folder of suite eval")
    results, summary = read_trials(path), read_json(folder / "summary.json", judged=dict)
    if len({(row.trial, row.policy) for row in results}) < len(results):
        raise ValueError(f"{path}: holds a trial twice; run suite eval again")
    conditions = {key: summary["judged"].get(key) for key in CONDITIONS}
    conditions["files"] = summary.get("sha256")
    names = list(dict.fromkeys(row.policy for row in results))
    return [
        Run(
            f"{folder}" if len(names) == 1 else f"{folder}: {name}",
            {row.trial: row for row in results if row.policy == name},
            conditions,
        )
        for name in names
    ]


def refuse_other_conditions(first: Run, other: Run) -> None:
    """Refuse runs that were judged under other conditions or on other trials.

    Raises:
        ValueError: naming what differs and what to do.
    """
    for key, value in first.conditions.items():
        theirs = other.conditions.get(key)
        if theirs != value:
            what = "vehicle or tracks" if key == "files" else key
            said = "" if key == "files" else f" ({value} and {theirs})"
            raise ValueError(
                f"{first.name} and {other.name}: judged under another {what}{said}; run suite eval "
                "again with the same options"
            )
    only = first.rows.keys() ^ other.rows.keys()
    if only:
        trial = min(only)
        raise ValueError(
            f"{first.name} and {other.name}: {len(only)} trials are in only one of them, such as "
            f"{trial.track}, level {trial.difficulty}, seed {trial.seed}; run suite eval for both "
            "with the same --track, --difficulty, --trials and --seed"
        )


def paired(first: Run, other: Run) -> dict[str, Any]:
    """Return the difference of two runs on the same trials, as numbers and as a sentence.

    Raises:
        ValueError: if conditions or trials differ.
    """
    refuse_other_conditions(first, other)
    trials = list(first.rows)
    one, two = (np.array([run.rows[t].success for t in trials]) for run in (first, other))
    found = paired_success(one, two)
    return {
        "first": first.name,
        "second": other.name,
        "trials": len(trials),
        "success": [float(one.mean()), float(two.mean())],
        "difference": found,
        "sentence": paired_sentence(first.name, other.name, one, two),
    }


def paired_sentence(first: str, second: str, one: np.ndarray, two: np.ndarray) -> str:
    """Return a sentence on the successes (n,) of two policies on the same trials."""
    found = paired_success(one, two)
    value, low, high = (100 * number for number in (found.value, found.low, found.high))
    return (
        f"{first} succeeded in {100 * one.mean():.1f} % and {second} in {100 * two.mean():.1f} % "
        f"of the same {len(one)} trials: {first} minus {second} is {value:+.1f} percentage points "
        f"(paired, 95 % interval {low:+.1f} to {high:+.1f}, Newcombe 1998; exact McNemar test, "
        f"p = {found.p_value:.2g})."
    )


def seeds_of(runs: Sequence[Run], others: Sequence[Run] = ()) -> dict[str, Any]:
    """Return mean, spread and interval of the success rate over training seeds and trials.

    Args:
        runs: the training seeds of a method, all judged on the same trials.
        others: those of a second method; its rate is subtracted.

    Raises:
        ValueError: if conditions or trials differ, or a method has only one seed.
    """
    for run in (*runs[1:], *others):
        refuse_other_conditions(runs[0], run)
    trials = list(runs[0].rows)
    groups = [
        np.array([[run.rows[trial].success for trial in trials] for run in group], float)
        for group in (runs, others)
        if group
    ]
    found, how = over_seeds(groups[0], groups[1] if others else None), "hierarchical bootstrap"
    if found.low == found.high:  # Equal results give a bootstrap interval of no width.
        one, *two = (group[0] > 0.5 for group in groups)
        found, how = wilson(int(one.sum()), len(one)), "over trials only: Wilson"
        if two:
            found, how = Interval(*paired_success(one, two[0])[:3]), "over trials only: Newcombe"
    rates = [[float(rate) for rate in group.mean(1)] for group in groups]
    return {
        "trials": len(trials),
        "success_by_seed": rates,
        "spread": [float(np.std(group, ddof=1)) for group in rates],
        "mean": found,
        "sentence": _seeds_sentence(found, rates, len(trials), how),
    }


def _seeds_sentence(
    found: Interval, rates: Sequence[Sequence[float]], trials: int, how: str
) -> str:
    value, low, high = (100 * number for number in found)
    count = " and ".join(str(len(group)) for group in rates)
    means = " and ".join(
        f"{np.mean(group):.1%} (standard deviation over seeds {100 * np.std(group, ddof=1):.1f})"
        for group in rates
    )
    what, sign = ("a difference of ", "+") if len(rates) > 1 else ("", "")
    unit = "percentage points" if sign else "%"
    return (
        f"Over {count} training seeds and {trials} trials the success rate was {means}: "
        f"{what}{value:{sign}.1f} {unit} (95 % interval over seeds and trials {low:{sign}.1f} to "
        f"{high:{sign}.1f}, {how})."
    )

"""Compare the success rates of separate evaluations on the same trials (`suite compare`).

Evaluations on different trials or under different conditions are refused. Policies of one method
that differ only in the seed of their training are compared as a group.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np

from eval.judging.results import read_trials
from eval.judging.statistics import Interval, over_seeds, paired_success, wilson
from eval.judging.tables import rate_text
from eval.worlds.trial import TrialResult, TrialSpec
from suite.judging.flying import manners
from tracks.input.reading import read_json

CONDITIONS = ("simulator", "time_limit_s", "deadline_s")
"""Settings that change the result of a trial, besides the trial itself and the input files."""
TRACK = "track "
"""Start of the name of an input that is a track file; its path follows."""
PACKAGES = ("numpy", "mujoco", "jax", "torch", "onnxruntime")
"""Packages of the judge and of policies, whose versions may change a result."""
OF_SIMULATOR = {"mjx": ("mujoco-mjx",), "rotorpy": ("rotorpy",)}
"""Simulator -> the packages that only it needs."""


class Run(NamedTuple):
    """The trials of one policy in one evaluation."""

    name: str
    """Label in messages: the evaluation's folder, with the policy if the folder holds several."""
    rows: dict[TrialSpec, TrialResult]
    """The result of each trial."""
    conditions: dict[str, Any]
    """Settings that must be the same for a comparison."""
    inputs: dict[str, str]
    """Name of each input, such as the vehicle -> its SHA-256, which must be the same as well."""
    versions: dict[str, Any]
    """Versions of the suite, packages and plugins, and the processor, which may change results."""
    manner: str
    """End of the policy's label that says how it flew, such as "@0.5+monitor"; see `Manner`."""
    digest: str
    """SHA-256 of the policy's files."""
    settings: str | None
    """SHA-256 of the settings of its training, without the seed; None if not recorded."""


def read_runs(folder: Path) -> list[Run]:
    """Return one run for each policy in the folder of an evaluation.

    Raises:
        ValueError: if the folder has no evaluation, or files that `suite eval` did not write.
    """
    path = folder / "trials.parquet"
    if not path.is_file():
        raise ValueError(f"{folder}: holds no trials.parquet; give the --out folder of suite eval")
    results = read_trials(path)
    summary = read_json(folder / "summary.json", judged=dict, sha256=dict, policies=list)
    if len({(row.trial, row.policy) for row in results}) < len(results):
        raise ValueError(f"{path}: holds a trial twice; run suite eval again")
    judged = summary["judged"]
    conditions = {key: judged.get(key) for key in CONDITIONS}
    versions = {key: summary.get(key) for key in ("suite_version", "git_commit")}
    if (record := folder / "run.json").is_file():
        run = read_json(record, packages=dict, machine=dict)
        used = (*PACKAGES, *OF_SIMULATOR.get(str(conditions["simulator"]), ()))
        versions |= {name: run["packages"].get(name) for name in used}
        versions |= {"plugins": run.get("plugins"), "processor": run["machine"].get("processor")}
    names = list(dict.fromkeys(row.policy for row in results))
    flown = manners(judged.get("speed") or (), bool(judged.get("monitor")))
    endings = sorted((manner.label("") for manner in flown), key=len, reverse=True)
    # The summary has an entry for each label, in the order of the rows.
    policies = [one for one in summary["policies"] if isinstance(one, dict)]
    digests = [
        (one["sha256"], one.get("settings_sha256"))
        for one in policies
        if isinstance(one.get("sha256"), str)
    ]
    if len(digests) < max(len(names), len(summary["policies"])):
        raise ValueError(
            f"{folder / 'summary.json'}: has no SHA-256 for each of the {len(names)} policies in "
            "trials.parquet; the file was edited or is incomplete: run suite eval again"
        )
    return [
        Run(
            f"{folder}" if len(names) == 1 else f"{folder}: {name}",
            {row.trial: row for row in results if row.policy == name},
            conditions,
            summary["sha256"],
            versions,
            next((ending for ending in endings if name.endswith(ending)), ""),
            *digest,
        )
        for name, digest in zip(names, digests, strict=False)
    ]


def without_folders(run: Run) -> Run:
    """Return a run whose tracks from files have the files' names, without their folders.

    The same file may have been given by another path. A trial depends on its name and content only.
    """
    tracks = [name.removeprefix(TRACK) for name in run.inputs if name.startswith(TRACK)]
    short = {track: PurePath(track).name for track in tracks}
    if len(set(short.values())) < len(short):
        return run  # two files of one name
    names = {TRACK + track: TRACK + name for track, name in short.items()}
    return run._replace(
        rows={t._replace(track=short.get(t.track, t.track)): row for t, row in run.rows.items()},
        inputs={names.get(name, name): digest for name, digest in run.inputs.items()},
    )


def refuse_other_conditions(first: Run, other: Run) -> None:
    """Refuse runs that were judged under other conditions or on other trials.

    Raises:
        ValueError: naming what differs and what to do.
    """
    of_first, of_other = (run.conditions | run.inputs for run in (first, other))
    pairs = {key: (of_first.get(key), of_other.get(key)) for key in of_first | of_other}
    if different := {key: pair for key, pair in pairs.items() if pair[0] != pair[1]}:
        # The value of a setting is printed, but not the digest of a file.
        names = [
            f"{key} ({values[0]} and {values[1]})" if key in CONDITIONS else key
            for key, values in different.items()
        ]
        raise ValueError(
            f"{first.name} and {other.name}: judged under different conditions: "
            f"{', '.join(names)}; run suite eval again with the same options"
        )
    unshared = first.rows.keys() ^ other.rows.keys()
    if unshared:
        trial = min(unshared)
        raise ValueError(
            f"{first.name} and {other.name}: {len(unshared)} trials are in only one of them, such "
            f"as {trial.track}, level {trial.difficulty}, seed {trial.seed}; run suite eval for "
            "both with the same --track, --difficulty, --trials and --seed"
        )


def version_notes(runs: Sequence[Run]) -> list[str]:
    """Return a note for each of the runs' `versions` that is not the same in all of them."""
    keys = dict.fromkeys(key for run in runs for key in run.versions)
    found = {key: dict.fromkeys(str(run.versions.get(key)) for run in runs) for key in keys}
    return [
        f"the runs were not made alike ({key}: {', '.join(values)}), which may change results"
        for key, values in found.items()
        if len(values) > 1
    ]


def policy_notes(runs: Sequence[Run], others: Sequence[Run] = ()) -> list[str]:
    """Return notes on compared runs of one policy, and of other commanded speeds or the monitor.

    Each of `runs` is compared with each of `others`, or the first one with the rest.
    """
    pairs = [(run, other) for run in runs for other in others] or [
        (runs[0], other) for other in runs[1:]
    ]
    notes = []
    for run, other in pairs:
        names = f"{run.name} and {other.name}"
        if run.manner != other.manner:
            notes.append(f"{names}: --speed or --monitor differ, which the difference includes")
        elif run.digest == other.digest:
            notes.append(f"{names}: have the same policy, so no difference is expected")
    return notes


def seed_notes(runs: Sequence[Run]) -> list[str]:
    """Return warnings if `runs` may be no training seeds of one method, by recorded settings."""
    known = [run for run in runs if run.settings]
    unknown = ", ".join(run.name for run in runs if not run.settings)
    note = (
        f"warning: no settings of a training are recorded for {unknown}, so whether these are "
        "training seeds of one method is unknown"
    )
    return [note] * bool(unknown) + [
        f"warning: {known[0].name} and {run.name}: were trained with different settings or for "
        "different numbers of iterations, which the spread over seeds includes; compare "
        "config.json of the two policies"
        for run in known
        if run.settings != known[0].settings
    ][:1]


def compare_runs(first: Run, other: Run) -> dict[str, Any]:
    """Return the difference of two runs on the same trials, as numbers and as a sentence.

    Raises:
        ValueError: if conditions or trials differ.
    """
    refuse_other_conditions(first, other)
    trials = list(first.rows)
    successes, other_successes = (
        np.array([run.rows[trial].success for trial in trials]) for run in (first, other)
    )
    return {
        "first": first.name,
        "second": other.name,
        "trials": len(trials),
        "success": [float(successes.mean()), float(other_successes.mean())],
        "difference": paired_success(successes, other_successes),
        "sentence": paired_sentence(first.name, other.name, successes, other_successes),
    }


def paired_sentence(name_a: str, name_b: str, a: np.ndarray, b: np.ndarray) -> str:
    """Return a sentence on the success rates of two policies on the same trials.

    `a` and `b`, (n,) bool, are the successes of the policies `name_a` and `name_b`.
    """
    difference = paired_success(a, b)
    value, low, high = (100 * number for number in difference[:3])
    return (
        f"{name_a} succeeded in {rate_text(a.mean(), 1)} % and {name_b} in "
        f"{rate_text(b.mean(), 1)} % of the same {len(a)} trials: {name_a} minus {name_b} is "
        f"{value:+.1f} percentage points (paired, 95 % interval {low:+.1f} to "
        f"{high:+.1f}, Newcombe 1998; exact McNemar test, p = {difference.p_value:.2g})."
    )


def compare_seeds(runs: Sequence[Run], others: Sequence[Run] = ()) -> dict[str, Any]:
    """Return the success rate of a method, or the difference of two methods, over training seeds.

    It has the mean, its interval over seeds and trials, and the standard deviation over seeds. A
    method has a run for each training seed, all on the same trials. The rate of `others`, if there
    are any, is subtracted.

    Raises:
        ValueError: if conditions or trials differ, or there is one trial, or a method has one seed,
            the same policy twice, several commanded speeds or the monitor in some of its runs.
    """
    for run in (*runs[1:], *others):
        refuse_other_conditions(runs[0], run)
    for group in (runs, others):
        policies: dict[str, Run] = {}
        for run in group:
            if run.manner != group[0].manner:
                raise ValueError(
                    f"{group[0].name} and {run.name}: are no training seeds of one method, because "
                    "their --speed or --monitor differ; run suite eval for each of them alone"
                )
            if (first := policies.setdefault(run.digest, run)) is not run:
                raise ValueError(
                    f"{first.name} and {run.name}: have the same policy, which is one training "
                    "seed; give a policy of another seed"
                )
    trials = list(runs[0].rows)
    # Successes of each method, (seeds, trials).
    groups = [
        np.array([[run.rows[trial].success for trial in trials] for run in group], float)
        for group in (runs, others)
        if group
    ]
    interval = over_seeds(groups[0], groups[1] if others else None)
    method = "hierarchical bootstrap"
    # If all seeds have equal results, the bootstrap interval has no width: use one over trials.
    if interval.low == interval.high:
        successes, *others_successes = (group[0] > 0.5 for group in groups)
        interval, method = wilson(int(successes.sum()), len(successes)), "over trials only: Wilson"
        if others_successes:
            interval = Interval(*paired_success(successes, others_successes[0])[:3])
            method = "over trials only: Newcombe"
    lowest = -1.0 if others else 0.0
    interval = interval._replace(low=max(lowest, interval.low), high=min(1.0, interval.high))
    rates = [[float(rate) for rate in group.mean(1)] for group in groups]
    return {
        "runs": [[run.name for run in group] for group in (runs, others) if group],
        "trials": len(trials),
        "success_by_seed": rates,
        "spread": [float(np.std(group, ddof=1)) for group in rates],
        "mean": interval,
        "sentence": _seeds_sentence(interval, rates, len(trials), method),
    }


def _seeds_sentence(
    interval: Interval, rates: Sequence[Sequence[float]], trials: int, method: str
) -> str:
    """Return a sentence on the success rate of one method over seeds, or on that of two methods."""
    value, low, high = (100 * number for number in interval)
    count = " and ".join(str(len(group)) for group in rates)
    means = " and ".join(
        f"{rate_text(float(np.mean(group)), 1)} % (standard deviation over seeds "
        f"{100 * np.std(group, ddof=1):.1f} percentage points)"
        for group in rates
    )
    prefix, sign, unit = "", "", "%"
    if len(rates) > 1:
        prefix, sign, unit = "a difference of ", "+", "percentage points"
    return (
        f"Over {count} training seeds and {trials} trials the success rate was {means}: "
        f"{prefix}{value:{sign}.1f} {unit} (95 % interval over seeds and trials {low:{sign}.1f} to "
        f"{high:{sign}.1f}, {method})."
    )

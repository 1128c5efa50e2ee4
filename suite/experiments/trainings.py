"""Trainings that are kept for good: whoever asks for the same configuration gets its policy."""

from __future__ import annotations

import json
from pathlib import Path

from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.experiments.cache import digest
from suite.train import curve
from suite.train.config import TrainConfig
from suite.train.repeat import Outcome
from suite.train.run import train


def trained(config: TrainConfig, cache: Path, console: Console) -> Outcome:
    """Return what the training of `config` came to; it is done, or gone on with, where missing.

    The run's folder is named by the configuration alone: code that has changed since does not
    start it anew, so a document should say `commit_of` the run.

    Args:
        config: the whole run, its seed included.
        cache: folder of all runs.
        console: where progress goes.

    Raises:
        WorkFailed: where the training diverges.
    """
    return train(config, folder_of(config, cache), console)


def divergence(config: TrainConfig, cache: Path, console: Console) -> str:
    """Train as `trained` does and return what was said where it diverged, "" where it did not."""
    try:
        trained(config, cache, console)
    except WorkFailed as failure:
        return str(failure)
    return ""


def trained_policy(config: TrainConfig, console: Console, cache: Path) -> str:
    """Return the folder of the policy of `trained`, as work that can be done side by side."""
    return str(trained(config, cache, console).policy)


def folder_of(config: TrainConfig, cache: Path) -> Path:
    """Return the folder of the run of `config`."""
    return cache / "trainings" / digest(config)


def warm_seconds(run: Path) -> float:
    """Return what the folder's run spent on gradient steps, without those that compile [s]."""
    return sum(row["seconds"] for row in curve.read(run) if not row["cold"])


def commit_of(policy: Path) -> str:
    """Return the commit that trained `policy` (RUN/policy), "unknown" where nothing says so.

    A training that was stopped and gone on with may have several: all of them.
    """
    path = policy.parent / "run.json"
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        return ", ".join([*record.get("earlier_commits", []), record["git_commit"] or "unknown"])
    except (OSError, ValueError, KeyError):
        return "unknown"

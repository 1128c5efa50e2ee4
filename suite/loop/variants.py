"""Describe a loop as data: its policies, and the dynamics in which they are fine-tuned and judged.

There is one fine-tuned policy for each way to correct the simulation; all policies are called
variants. The folder of a loop has, in the order of the stages:
- train/ or given/: the first policy, trained or copied; eval-X/: its trials, X is its name
- flights/: the recorded flights; with a hidden vehicle also measured/ (with noise) and diagnosis/
- a folder for each Delta Action Model
- tuned-X/ and eval-X/: each fine-tuned policy X and its trials
- replays/: pictures of flights
- table.md, loop.json, report.html and recording.rrd: the results
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from suite.common.report import Section
from suite.loop.compare import PolicyResult
from suite.loop.config import LoopConfig

COLOURS = ("#8b93a1", "#c0504d", "#e0892b", "#7a5fb5", "#2463c9", "#2e9e6b")
"""Colours of up to six policies."""


@dataclass(frozen=True)
class Variant:
    """A policy of the loop. The results of its trials are in eval-NAME/."""

    name: str
    """Name of the policy, a part of the names of its folders."""
    judged: str
    """Description of the judging, for the progress display."""
    tuned: str | None = None
    """Description of the fine-tuning, whose folder is tuned-NAME/; None for the first policy."""
    delta: str | None = None
    """Folder of the Delta Action Model that corrects actions in the fine-tuning; None without."""
    diagnosed: bool = False
    """Whether the fine-tuning uses the vehicle file that the diagnosis corrected."""
    simulated: bool = False
    """Whether the policy is judged with the simulation's vehicle instead of the true one."""


@dataclass(frozen=True)
class DeltaModel:
    """A fit of a Delta Action Model, a network that corrects actions to match measured flights."""

    folder: str
    title: str
    """Description of the fit, for the progress display."""
    diagnosed: bool = False
    """Whether the model is fitted to the vehicle file that the diagnosis corrected, instead of the
    given one."""


class ShownPolicy(NamedTuple):
    """A policy whose flights are in the recording and the pictures."""

    variant: str
    label: str
    """Label of its flights in the recording."""
    heading: str
    """Heading of the picture of its flights."""


@dataclass(frozen=True)
class Findings:
    """The results of a loop."""

    verdict: str
    errors: Sequence[str]
    """Tables of the Delta Action Models' errors, as Markdown."""
    numbers: Mapping[str, Any]
    """Results for loop.json, by key."""
    facts: Mapping[str, str]
    """Further conditions of the trials for the report, by name, such as the vehicle."""
    sections: Sequence[Section]
    """Sections of the report between the policies and the flights."""


@dataclass(frozen=True)
class Loop:
    """A kind of loop."""

    title: str
    hidden: bool
    """Whether the loop has a hidden vehicle. Then its flights get measurement noise and are
    diagnosed before a fit."""
    variants: Sequence[Variant]
    """The policies, in the order of tables and stages."""
    models: Sequence[DeltaModel]
    """The fits of Delta Action Models, in the order of the stages."""
    labels: Mapping[str, str]
    """Label of each policy in tables."""
    references: Sequence[str]
    """Policies with which the others are compared."""
    shown: Sequence[ShownPolicy]
    """The policy before the fine-tuning, and one after it."""
    summarise: Callable[[LoopConfig, Path, Sequence[PolicyResult]], Findings]
    """(settings, folder of the finished loop, results of the policies) -> the findings."""
    reading: str
    """Explanation of the tables, for the report."""
    advice: str
    """Advice if the flights are too short for a fit."""
    files: Sequence[tuple[str, str]]
    """Links of the report: path of a file in the loop's folder, and its description."""

"""Describe a loop as data: its policies, with the dynamics of their fine-tuning and judging.

A loop flies a policy, corrects the simulation from these flights, fine-tunes the policy in it and
judges both. The judge is the simulator that scores policies.

A loop's folder has train/ (or given/), eval-X/ of the first policy, flights/, with a hidden vehicle
measured/ and diagnosis/, a folder for each Delta Action Model, tuned-X/ and eval-X/ of each
fine-tuned policy X, and replays/; then table.md, loop.json, report.html and recording.rrd.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from eval.worlds.trial import TrialResult
from suite.common.report import Picture, Section
from suite.loop.config import LoopConfig
from tracks.common.grid import Grid


@dataclass(frozen=True)
class Variant:
    """A policy of the loop, judged in eval-NAME/."""

    name: str
    """Name of the policy, a part of its folders' names."""
    judged: str
    """Description of the judging."""
    tuned: str | None = None
    """Description of the fine-tuning in tuned-NAME/; None for the first policy."""
    delta: str | None = None
    """Folder of the Delta Action Model in the fine-tuning."""
    diagnosed: bool = False
    """Whether the fine-tuning flies the vehicle that the diagnosis corrected."""
    simulated: bool = False
    """Whether the policy is judged with the simulation's vehicle instead of the true one."""


@dataclass(frozen=True)
class DeltaModel:
    """A fit of a Delta Action Model, a network that corrects actions to match measured flights."""

    folder: str
    """Name of the model's folder."""
    title: str
    """Description of the fit."""
    diagnosed: bool = False
    """Whether it corrects the vehicle that the diagnosis corrected."""


class ShownPolicy(NamedTuple):
    """A policy in the recording and the pictures."""

    variant: str
    """Name of the policy."""
    label: str
    """Label of its flights in the recording."""
    heading: str
    """Heading of the picture of its flights."""


@dataclass(frozen=True)
class Findings:
    """The results of a loop."""

    verdict: str
    """The result in a few sentences."""
    tables: Sequence[Grid]
    """Tables of the policies."""
    errors: Sequence[str]
    """Errors of the Delta Action Models, as Markdown."""
    numbers: Mapping[str, Any]
    """Numbers for loop.json."""
    facts: Mapping[str, str]
    """Conditions by name, for the report."""
    chart: Picture
    """Chart of the policies."""
    sections: Sequence[Section]
    """Sections of the report between the policies and the flights."""


@dataclass(frozen=True)
class Loop:
    """A kind of loop."""

    title: str
    """Title of the report."""
    hidden: bool
    """Whether the flights get measurement noise and are diagnosed before a fit."""
    variants: Sequence[Variant]
    """The policies, in the order of tables and stages."""
    models: Sequence[DeltaModel]
    """The fits, in the order of stages."""
    shown: Sequence[ShownPolicy]
    """The policy before the fine-tuning, and the one after."""
    summarise: Callable[[LoopConfig, Path, Mapping[str, Sequence[TrialResult]]], Findings]
    """Returns the findings, from the configuration, the folder and the results by variant."""
    reading: str
    """Explanation of the tables."""
    caveat: str
    """Note on what the intervals do not include."""
    advice: str
    """Advice if the flights are too short for a fit."""
    files: Sequence[tuple[str, str]]
    """Paths of the report's links, with descriptions."""

"""A loop as data: the compared policies, with the dynamics of their fine-tuning and judging.

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
    """Of its folders."""
    judged: str
    """Description of the judging."""
    tuned: str | None = None
    """Description of the fine-tuning in tuned-NAME/; None for the first policy."""
    delta: str | None = None
    """Folder of the Delta Action Model in the fine-tuning."""
    diagnosed: bool = False
    """Whether the fine-tuning is through the vehicle that the diagnosis corrected."""
    simulated: bool = False
    """Whether it is judged with the simulation's vehicle instead of the true one."""


@dataclass(frozen=True)
class DeltaModel:
    """A fit of a Delta Action Model."""

    folder: str
    """Its folder."""
    words: str
    """Description of the fit."""
    diagnosed: bool = False
    """Whether it corrects the vehicle that the diagnosis corrected."""


class Shown(NamedTuple):
    """A policy in the recording and the pictures."""

    variant: str
    """Its name."""
    label: str
    """Its label in the recording."""
    heading: str
    """Heading of its picture."""


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
    """Of the report."""
    hidden: bool
    """Whether the flights get measurement noise and are diagnosed before a fit."""
    variants: Sequence[Variant]
    """In the order of tables and stages."""
    models: Sequence[DeltaModel]
    """Fits, in the order of stages."""
    shown: Sequence[Shown]
    """First the policy before, then the one after."""
    find: Callable[[LoopConfig, Path, Mapping[str, Sequence[TrialResult]]], Findings]
    """Makes the findings from the configuration, the folder and the results by variant."""
    reading: str
    """How to read the tables."""
    caveat: str
    """What the intervals do not include."""
    advice: str
    """Advice if the flights are too short for a fit."""
    files: Sequence[tuple[str, str]]
    """Paths of the report's links, with descriptions."""

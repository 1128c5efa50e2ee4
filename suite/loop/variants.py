"""A loop as data: the policies that it compares, what each is tuned through and judged in.

A loop's folder holds train/ (or given/), eval-X/ of the first policy, flights/, in a hidden vehicle
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
    """The judging, in words."""
    tuned: str | None = None
    """The fine-tuning in tuned-NAME/, in words; None: it is the first policy."""
    delta: str | None = None
    """Folder of the Delta Action Model that corrects what it is fine-tuned through."""
    diagnosed: bool = False
    """Whether it is fine-tuned through the vehicle that the diagnosis corrected."""
    simulated: bool = False
    """Whether the simulation's vehicle flies when it is judged, not the true one."""


@dataclass(frozen=True)
class DeltaModel:
    """A Delta Action Model that is fitted."""

    folder: str
    """Where."""
    words: str
    """The fitting, in words."""
    diagnosed: bool = False
    """Whether it corrects the vehicle that the diagnosis corrected."""


class Shown(NamedTuple):
    """A policy that is in the recording and the pictures."""

    variant: str
    """Its name."""
    label: str
    """What the recording calls it."""
    heading: str
    """Over its picture."""


@dataclass(frozen=True)
class Findings:
    """What a loop came to."""

    verdict: str
    """In a few sentences."""
    tables: Sequence[Grid]
    """Of the policies."""
    errors: Sequence[str]
    """Of the Delta Action Models, as Markdown."""
    numbers: Mapping[str, Any]
    """What loop.json holds of them."""
    facts: Mapping[str, str]
    """What flew, by name, for the report."""
    chart: Picture
    """Of the policies."""
    sections: Sequence[Section]
    """The report's, between the policies and the flights."""


@dataclass(frozen=True)
class Loop:
    """A declaration."""

    title: str
    """Of the report."""
    hidden: bool
    """Whether the flights are measured and diagnosed before anything is fitted to them."""
    variants: Sequence[Variant]
    """In the order of tables and stages."""
    models: Sequence[DeltaModel]
    """In the order of stages."""
    shown: Sequence[Shown]
    """First the one before, then the one after."""
    find: Callable[[LoopConfig, Path, Mapping[str, Sequence[TrialResult]]], Findings]
    """Makes the findings from the configuration, the folder and the results by variant."""
    reading: str
    """How to read the tables."""
    caveat: str
    """What their intervals do not say."""
    advice: str
    """What to do where the flights are too short to be fitted."""
    files: Sequence[tuple[str, str]]
    """Paths that the report links to, with what is there."""

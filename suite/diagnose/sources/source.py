"""Base class of a source of evidence: what it fits, what it holds out, how it judges effects.

A new source is one subclass of `Source` and one function that makes it from flights, with an entry
in `SOURCES` (`suite/diagnose/diagnose.py`). Search, held-out test, relevance, verdict, JSON and
report use only this interface.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.estimate.block import Block, Estimate
from suite.diagnose.estimate.parameters import Candidate, ParameterSpace
from suite.diagnose.evidence.evidence import Evidence
from suite.diagnose.search.evaluation import NamedEffect, SearchResult
from suite.diagnose.search.search import search
from suite.diagnose.thresholds import Thresholds
from suite.diagnose.verdict.disturbances import Swing
from suite.diagnose.verdict.gap import EffectSize, Gap
from suite.diagnose.verdict.rollout_gap import Rollouts


class TestedEffect(NamedTuple):
    """An effect that is named by a separate test, not by the search: rotor lag, random wind."""

    name: str
    values: Any
    """What a vehicle file holds of it."""
    parameters: Mapping[str, Any]
    """As diagnosis.json has them: value, unit and 95 % interval of each."""
    gap_removed: float | None
    p_value: float
    view: str
    """In what it was found."""
    words: str = ""
    """A sentence for people, where its size needs one."""


class Remaining(NamedTuple):
    """The residual that the named effects leave."""

    structured: bool
    """Whether it is significantly more than noise."""
    share: float
    """Of the gap above the noise floor [1]."""
    where: str | None = None
    """What it depends on, in words."""
    explainable: float = 0.0
    """Share of the gap that a black box closes, where one was fitted [1]."""
    wind: TestedEffect | None = None
    """Random wind that explains it."""
    swing: Swing | None = None
    details: Mapping[str, Any] = {}
    """Further entries of `unexplained` in diagnosis.json."""
    gap_details: Mapping[str, Any] = {}
    """Further entries of `gap`."""
    channels: Mapping[str, Mapping[str, Any]] = {}
    """Further entries by channel of the gap."""


class Series(NamedTuple):
    """A held-out stretch as measured and as simulated, for a picture."""

    time_s: np.ndarray
    """(N,); NaN where a line breaks."""
    measured: np.ndarray
    """(N,)."""
    simulated: Mapping[str, np.ndarray]
    """(N,) by what it is called."""
    label: str
    """What is shown, along which axis, in which unit."""
    caption: str


@dataclass(frozen=True, kw_only=True)
class Source(ABC):
    """One kind of evidence from flights: some flights are fitted, the others held out."""

    name: str
    """As `views` of a diagnosis has it."""
    about: str
    """What is compared under what, for people."""
    subject: str
    """What the gap is an error of, for people."""
    unit: str
    """Of the gap."""
    measure: str
    """How the gap is measured, for people."""
    horizon_s: float
    """Over which it is measured [s]."""
    known: tuple[Evidence, Block]
    """The fitted flights, weighed where the search begins, and their block there."""
    start: Estimate
    """The vehicle file's parameters, from which the search starts."""
    among: Sequence[Candidate]
    """The candidates."""
    limits: Thresholds
    keeps_small: bool = False
    """Whether effects below the threshold of relevance are named, too: a change is judged by how
    flights differ."""
    small_explains: bool = False
    """Whether the residual is computed with effects that are too small to be named."""
    otherwise: Source | None = None
    """The source that is searched where this one names nothing."""
    rollouts: Rollouts | None = None
    """The simulated flights, for recordings, plans and a fitted network; None without rollouts."""

    @property
    def space(self) -> ParameterSpace:
        """The catalogue's parameters."""
        return self.known[0].space

    @abstractmethod
    def gap(self, found: SearchResult, theta: np.ndarray) -> Gap:
        """Return the gap on the held-out flights at `theta` (P,), by the noise of `found`."""

    @abstractmethod
    def remaining(self, found: SearchResult, gaps: tuple[Gap, Gap], seed: int) -> Remaining:
        """Return what `found` leaves; `gaps` are those before and after, `seed` is of draws."""

    def search(self, say: Callable[[str], None], seed: int) -> SearchResult:
        """Return what explains the fitted flights."""
        return search(self.known[0], self.start, self.among, say, seed, self.known)

    def worse(self, before: Gap, after: Gap) -> bool:
        """Return whether held-out flights contradict the effects that changed the gap to `after`.

        Both the whole error and the error within flights have to grow: a flight's own trim may
        raise the first alone.
        """
        return after.rms >= before.rms and float(after.energy.sum()) >= float(before.energy.sum())

    def shows(self, found: SearchResult, one: Candidate) -> bool:
        """Return whether held-out flights are sensitive enough to show `one` at its fitted size."""
        del found, one
        return False

    def matters(self, gap: Gap) -> bool:
        """Return whether `gap` may exceed the noise by a relevant amount."""
        del gap
        return True

    def sizes(self, found: SearchResult) -> dict[str, tuple[EffectSize, EffectSize]]:
        """Return by effect its size on these flights, and the upper end of that size's interval.

        Empty where that has no physical unit: then no effect is too small.
        """
        del found
        return {}

    def stepped(self, found: SearchResult) -> bool:
        """Return whether the named effects may be caused by a simulator's time steps."""
        del found
        return False

    def model_error(self, found: SearchResult) -> float | None:
        """Return the share of the noise floor that is the model's numerical error, if known."""
        del found
        return None

    def series(self, found: SearchResult) -> Series | None:
        """Return a held-out stretch for a picture, with what was named where something was."""
        del found
        return None


@dataclass(frozen=True)
class Given:
    """The input of a diagnosis."""

    logs: Sequence[FlightLog]
    vehicle: Vehicle
    references: Sequence[FlightLog]
    """Flights of the same vehicle before a change."""
    drive: str
    """What the model's input is: "commands", "motors" or "auto"."""
    integrator: str
    """How the flights' bodies were moved: "continuous", "euler" or "auto"."""
    say: Callable[[str], None]
    limits: Thresholds
    chosen: bool
    """Whether the source was chosen by name; then it raises an error where it cannot be used."""


@dataclass(frozen=True)
class Sources:
    """The sources of evidence that flights allow."""

    sources: tuple[Source, ...]
    held_out: Sequence[str]
    """Names of what is held out."""
    driven_by: str
    """What the model's input is, for people."""
    warnings: Sequence[str] = ()
    tested: tuple[TestedEffect, ...] = ()
    compares: tuple[str, ...] = ()
    """How flights of the unchanged vehicle differ, in words, where a change is searched for."""

    def joined(self, more: Sources) -> Sources:
        """Return these and `more` together."""
        return Sources(
            (*self.sources, *more.sources),
            tuple(dict.fromkeys([*self.held_out, *more.held_out])),
            self.driven_by or more.driven_by,
            (*self.warnings, *more.warnings),
            (*self.tested, *more.tested),
            (*self.compares, *more.compares),
        )


@dataclass(frozen=True)
class Finding:
    """What one source found."""

    source: Source
    search: SearchResult
    names: tuple[NamedEffect, ...]
    """The named effects that stand after the comparison with other sources."""
    before: Gap
    after: Gap
    without: Mapping[str, Gap]
    """By a named effect's label: the gap with all others."""
    half_width: Mapping[int, float]
    """Of the 95 % interval, by the place of each named number."""
    sizes: Mapping[str, EffectSize]
    """What each named effect does on these flights."""
    negligible: tuple[tuple[str, EffectSize], ...]
    """Effects that are significant and too small to matter."""
    remaining: Remaining
    control: tuple[str, Gap] | None = None
    """A wrong effect fitted in the same way, and its gap."""

    @property
    def theta(self) -> np.ndarray:
        """(P,) all parameters, as fitted."""
        return self.search.estimate.theta

    def by_effect(self) -> dict[str, list[NamedEffect]]:
        """Return the names by their effect: one motor is a name of its own."""
        found: dict[str, list[NamedEffect]] = {}
        for one in self.names:
            found.setdefault(one.candidate.name, []).append(one)
        return found

    def removed(self, names: Sequence[NamedEffect]) -> float:
        """Return the share of the gap that `names`, of one effect, take away when added last."""
        without = max(self.without[one.candidate.label].rms for one in names)
        whole = max(self.before.rms - self.before.floor, 1e-9)
        return min(max((without - self.after.rms) / whole, 0.0), 1.0)

"""Interface of a source of evidence, which compares flights with the model in one way.

A source may compare, for example, whole flights (rollouts), forces or torques. It fits some flights
and holds others out to test the result. A new source is one subclass of `Source` and one function
that makes it from flights, with an entry in `SOURCES` (`suite/diagnose/diagnose.py`). Search,
held-out test, relevance, verdict, JSON and report use only this interface.
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
from suite.diagnose.verdict.gap import EffectSize, Gap, upper_size
from suite.diagnose.verdict.rollout_gap import Rollouts

LEAST_GAP = 1e-9
"""A gap above the noise floor is at least this in divisions, in the gap's unit."""


class TestedEffect(NamedTuple):
    """An effect that a separate test named, not the search: rotor lag or random wind."""

    name: str
    values: Any
    """The effect's entry in a vehicle file."""
    parameters: Mapping[str, Any]
    """Value, unit and 95 % interval of each parameter, as in diagnosis.json."""
    gap_removed: float | None
    """Share of the gap that the effect explains [1]."""
    p_value: float
    view: str
    """Name of the source in which it was found."""
    words: str = ""
    """A sentence for people, if its size needs an explanation."""


class Remaining(NamedTuple):
    """The error that remains with the named effects."""

    structured: bool
    """Whether it is significantly more than noise."""
    share: float
    """Its share of the gap above the noise floor [1]."""
    where: str | None = None
    """Quantity that it depends on, in words."""
    explainable: float = 0.0
    """Share of the gap that a black box (a regression without physics) explains, if fitted [1]."""
    wind: TestedEffect | None = None
    """Random wind that explains it."""
    swing: Swing | None = None
    """An oscillating force, as of a load on a line."""
    details: Mapping[str, Any] = {}
    """Further entries of `unexplained` in diagnosis.json."""
    gap_details: Mapping[str, Any] = {}
    """Further entries of `gap` there."""
    channels: Mapping[str, Mapping[str, Any]] = {}
    """Further entries of `gap.channels` there, by group and channel."""


class Series(NamedTuple):
    """A held-out stretch as measured and as simulated, for a chart of N points."""

    time_s: np.ndarray
    """(N,) time; NaN where a line breaks."""
    measured: np.ndarray
    """(N,) measured values."""
    simulated: Mapping[str, np.ndarray]
    """(N,) simulated values, by their label in the legend."""
    label: str
    """Quantity, axis and unit."""
    caption: str
    """Text below the chart."""


@dataclass(frozen=True, kw_only=True)
class Source(ABC):
    """One way to compare flights with the model; some flights are fitted, the others held out.

    The gap is the error of the model on the held-out flights.
    """

    name: str
    """Name in `views` of diagnosis.json."""
    about: str
    """For people: compared quantity, and the signals that are given."""
    subject: str
    """For people: the quantity whose error the gap is."""
    unit: str
    """Unit of the gap."""
    measure: str
    """For people: definition of the gap."""
    horizon_s: float
    """Length of the windows over which the gap is measured [s]."""
    weighed: tuple[Evidence, Block]
    """The fitted flights with weights at the start of the search, and their linearisation there."""
    start: Estimate
    """The vehicle file's parameters, from which the search starts."""
    candidates: Sequence[Candidate]
    """Effects that the search tries."""
    limits: Thresholds
    names_small: bool = False
    """Whether effects below the threshold of relevance are named. True for a change since reference
    flights, which is compared with the spread between flights instead."""
    small_explains: bool = False
    """Whether the remaining error is computed with effects that are too small to be named."""
    fallback: Source | None = None
    """Source that is searched if this one names nothing."""

    @property
    def rollouts(self) -> Rollouts | None:
        """The simulated flights, for recordings, plans and a fitted network, if there are any."""
        return None

    @property
    def space(self) -> ParameterSpace:
        """The catalogue's parameters."""
        return self.weighed[0].space

    @abstractmethod
    def gap(self, found: SearchResult, theta: np.ndarray) -> Gap:
        """Return the gap on the held-out flights at `theta` (P,), by the noise of `found`."""

    @abstractmethod
    def remaining(self, found: SearchResult, gaps: tuple[Gap, Gap], seed: int) -> Remaining:
        """Return the error that remains after `found`.

        Args:
            found: result of the search.
            gaps: before and after it.
            seed: seed of random draws.
        """

    def search(self, say: Callable[[str], None], seed: int) -> SearchResult:
        """Search for the effects that explain the fitted flights."""
        return search(self.weighed[0], self.start, self.candidates, say, seed, self.weighed)

    def is_worse(self, before: Gap, after: Gap) -> bool:
        """Return whether held-out flights contradict effects that change the gap to `after`.

        Both the total error and the error within flights have to grow: a different trim of a
        held-out flight may raise the total alone.
        """
        return after.rms >= before.rms and float(after.energy.sum()) >= float(before.energy.sum())

    def would_show(self, found: SearchResult, candidate: Candidate) -> bool:
        """Return whether held-out flights are sensitive to `candidate` at its fitted size."""
        return False

    def is_relevant(self, gap: Gap) -> bool:
        """Return whether `gap` may exceed the noise by a relevant amount."""
        return True

    def sizes(self, found: SearchResult) -> dict[str, tuple[EffectSize, EffectSize]]:
        """Return by effect its size on these flights, and the upper end of that size's interval.

        Empty if the size has no physical unit; then no effect counts as too small.
        """
        return {}

    def explained_by_steps(self, found: SearchResult) -> bool:
        """Return whether a simulator's time steps may cause the named effects."""
        return False

    def model_error(self, found: SearchResult) -> float | None:
        """Return the share of the noise floor that is the model's numerical error, if known."""
        return None

    def series(self, found: SearchResult) -> Series | None:
        """Return a held-out stretch for a chart, simulated as given and with named effects."""
        return None


def sizes_by_effect(
    found: SearchResult,
    slope: np.ndarray,
    size_of: Callable[[np.ndarray], EffectSize],
    model_error: float | np.ndarray = 0.0,
) -> dict[str, tuple[EffectSize, EffectSize]]:
    """Return by named effect its size, and the upper end of the size's 95 % interval.

    Args:
        found: result of a search with K named parameters.
        slope: (..., K) of the flights' errors along these parameters.
        size_of: size of a change of the flights' errors.
        model_error: (K,) changes of the parameters by the model's own error, which do not count at
            the upper end.
    """
    entries, width, change = found.last.evidence.space.entries, found.half_widths(), found.moved
    least = np.sign(change) * np.maximum(np.abs(change) - model_error, 0.0)
    sizes = {}
    for name in dict.fromkeys(named.candidate.name for named in found.named):
        own = [k for k, index in enumerate(found.indices) if entries[index].effect == name]
        upper = upper_size(slope[..., own], least[own], width[own], size_of)
        sizes[name] = (size_of(slope[..., own] @ change[own]), upper)
    return sizes


@dataclass(frozen=True)
class DiagnosisInput:
    """The input of a diagnosis."""

    logs: Sequence[FlightLog]
    vehicle: Vehicle
    references: Sequence[FlightLog]
    """Flights of the same vehicle before a change."""
    drive: str
    """Input of the model: "commands", "motors" or "auto"."""
    integrator: str
    """Integration of the flights' bodies: "continuous", "euler" or "auto"."""
    say: Callable[[str], None]
    """Receives a line of progress for people."""
    limits: Thresholds
    chosen: bool
    """Whether the source was chosen by name; then it raises an error if it cannot be used."""


@dataclass(frozen=True)
class SourceSet:
    """The sources of evidence that flights allow."""

    sources: tuple[Source, ...]
    held_out: Sequence[str]
    """Names of held-out flights or stretches."""
    driven_by: str
    """Input of the model, for people."""
    warnings: Sequence[str] = ()
    tested: tuple[TestedEffect, ...] = ()
    compares: tuple[str, ...] = ()
    """For people, if a change is searched for: how flights of the unchanged vehicle differ."""

    def joined(self, more: SourceSet) -> SourceSet:
        """Return these and `more` together."""
        return SourceSet(
            (*self.sources, *more.sources),
            tuple(dict.fromkeys([*self.held_out, *more.held_out])),
            self.driven_by or more.driven_by,
            (*self.warnings, *more.warnings),
            (*self.tested, *more.tested),
            (*self.compares, *more.compares),
        )


@dataclass(frozen=True)
class Finding:
    """Result of one source."""

    source: Source
    search: SearchResult
    names: tuple[NamedEffect, ...]
    """Named effects after the comparison with other sources."""
    before: Gap
    """Gap of the given vehicle."""
    after: Gap
    """Gap with the named effects."""
    without: Mapping[str, Gap]
    """By the label of a named effect: the gap with all others."""
    half_width: Mapping[int, float]
    """Half-width of the 95 % interval, by the index of each named parameter."""
    sizes: Mapping[str, EffectSize]
    """Size of each named effect on these flights."""
    negligible: tuple[tuple[str, EffectSize], ...]
    """Significant effects that are too small to be relevant."""
    remaining: Remaining
    control: tuple[str, Gap] | None = None
    """A wrong effect that was fitted in the same way, and its gap."""

    @property
    def theta(self) -> np.ndarray:
        """(P,) all parameters, as fitted."""
        return self.search.estimate.theta

    def by_effect(self) -> dict[str, list[NamedEffect]]:
        """Return the names by their effect; an effect of one motor is a separate name."""
        groups: dict[str, list[NamedEffect]] = {}
        for named in self.names:
            groups.setdefault(named.candidate.name, []).append(named)
        return groups

    def removed(self, names: Sequence[NamedEffect]) -> float:
        """Return the share of the gap that `names`, of one effect, remove when added last."""
        without = max(self.without[named.candidate.label].rms for named in names)
        total = max(self.before.rms - self.before.floor, LEAST_GAP)
        return min(max((without - self.after.rms) / total, 0.0), 1.0)

"""Interface of a source of evidence, which compares flights with the model in one way.

A source belongs to one view (part of the dynamics): whole flights (rollouts), forces or torques. It
has the flights that are fitted and those that are held out to test the result. A new source is one
subclass of `Source` and one function that makes it from flights, with an entry in `SOURCES`
(`suite/diagnose/diagnose.py`).

Arrays of parameters have P entries: all parameters of all effects in the catalogue.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.estimate.block import Estimate
from suite.diagnose.estimate.parameters import Candidate, ParameterSpace
from suite.diagnose.evidence.evidence import Evaluation
from suite.diagnose.search.evaluation import NamedEffect, SearchResult
from suite.diagnose.search.search import search
from suite.diagnose.thresholds import Thresholds
from suite.diagnose.verdict.actuators import TestedEffect
from suite.diagnose.verdict.disturbances import Swing
from suite.diagnose.verdict.gap import EffectSize, Gap, beyond_error, less_error, upper_size

LEAST_GAP = 1e-9
"""Lower limit of a gap minus its noise floor in a division, in the gap's unit."""
TOGETHER = "together"
"""Key of the size that all named effects have together, see `Source.sizes`."""
TOO_SMALL = "that is too small to matter"
"""Reason of an error below the thresholds of relevance, see `Remaining.reason`."""

FAR = (
    "simulated flights of 1 s stay far from these flights, whatever effect is added: only force "
    "and torque are compared; check the commands' units, and the gains of the rate loop"
)
"""Warning if rollouts cannot be used."""
GIVEN, FITTED = "simulated as given", "simulated with the named effects"
"""Labels of the vehicle file's model and of the fitted model, in charts and recordings."""


class Remaining(NamedTuple):
    """The error that remains with the named effects."""

    structured: bool
    """Whether the error is significantly more than noise."""
    share: float
    """Share of the gap above the noise floor that remains."""
    where: str | None = None
    """Quantity that the error depends on, in words."""
    reason: str = "that depends on no tested quantity"
    """Words after "an error": why an error above the noise floor does not count as structure."""
    explainable: float = 0.0
    """Share of the gap that a black box (regression without physics) explains; 0 without one."""
    wind: TestedEffect | None = None
    """Random wind that explains the error."""
    swing: Swing | None = None
    """An oscillating force in the error, such as a load on a line causes."""
    visible: EffectSize | None = None
    """Smallest constant force and torque that the flights show, if known."""
    details: Mapping[str, Any] = {}
    """Further entries of `unexplained` in diagnosis.json."""
    gap_details: Mapping[str, Any] = {}
    """Further entries of `gap` in diagnosis.json."""
    channels: Mapping[str, Mapping[str, Any]] = {}
    """Further entries of `gap.channels` in diagnosis.json, by group and channel."""


class Series(NamedTuple):
    """A held-out stretch as measured and as simulated, for a chart of N points."""

    x: np.ndarray
    """(N,) time of each point [s], or number of its flight; NaN where a line breaks."""
    measured: np.ndarray
    """(N,) measured values."""
    simulated: Mapping[str, np.ndarray]
    """Simulated values (N,), by their label in the legend."""
    label: str
    """Label of the vertical axis: quantity, direction and unit."""
    caption: str
    """Text below the chart."""
    x_label: str = "time [s]"
    """Label of the horizontal axis; with "flight" each point is a flight of its own."""


@dataclass(frozen=True, kw_only=True)
class Source(ABC):
    """One way to compare flights with the model; some flights are fitted, the others held out.

    The gap is the error of the model on the held-out flights.
    """

    name: str
    """Name in `views` of diagnosis.json."""
    about: str
    """For people: the compared quantity, and the signals that the model takes as measured."""
    subject: str
    """For people: the quantity whose error the gap is."""
    unit: str
    """Unit of the gap."""
    measure: str
    """For people: definition of the gap."""
    horizon_s: float
    """Length of the windows over which the gap is measured [s]."""
    begin: Evaluation
    """The fitted flights with their noise, at the vehicle file's parameters, along all of them."""
    candidates: Sequence[Candidate]
    """Effects that the search tries."""
    limits: Thresholds
    names_small: bool = False
    """Whether effects below the threshold of relevance are named. True for a change since reference
    flights, which is compared with the spread between flights instead."""
    small_explains: bool = False
    """Whether effects that are too small to be named count as explaining the remaining error."""
    fallback: Source | None = None
    """A second source, which is searched if this one names nothing."""

    @property
    def space(self) -> ParameterSpace:
        """The catalogue's parameters."""
        return self.begin.evidence.space

    @property
    def start(self) -> Estimate:
        """The parameters from which the search starts."""
        return self.begin.at

    @property
    def window(self) -> str:
        """For people: the windows over which the gap is measured."""
        return f"windows of {self.horizon_s:g} s"

    @abstractmethod
    def gap(self, found: SearchResult, theta: np.ndarray) -> Gap:
        """Return the gap of a model with the parameters `theta` (P,) on the held-out flights."""

    @abstractmethod
    def remaining(self, found: SearchResult, gaps: tuple[Gap, Gap], seed: int) -> Remaining:
        """Return the error that remains after `found`, from the gaps without it and with it."""

    def search(self, say: Callable[[str], None], seed: int) -> SearchResult:
        """Search for the effects that explain the fitted flights."""
        return search(self.begin, self.candidates, say, seed)

    def is_worse(self, before: Gap, after: Gap) -> bool:
        """Return whether held-out flights contradict effects that change the gap to `after`.

        Total error and error within flights both have to grow: a held-out flight with another trim
        (constant offset) may raise the total alone.
        """
        rise = float(after.energy.sum()) - float(before.energy.sum())
        return after.total >= before.total and rise >= 0.0

    def would_show(self, found: SearchResult, candidate: Candidate) -> bool:
        """Return whether held-out flights are sensitive to `candidate` at its fitted size."""
        return False

    def sizes(self, found: SearchResult) -> dict[str, tuple[EffectSize, EffectSize]]:
        """Return the sizes of the named effects on these flights, by the effect's name.

        Each entry is the size and the upper end of its 95 % interval, zero if the model's own error
        may be the whole effect. The entry `TOGETHER` is for all at once, as changes may cancel.
        Without a physical unit there are none, and no effect counts as too small.
        """
        return {}

    def model_error(self, found: SearchResult) -> float | None:
        """Return the share of the noise floor that is the model's numerical error, if known."""
        return None

    def series(self, found: SearchResult) -> Series | None:
        """Return a held-out stretch for a chart, simulated as given and with named effects."""
        return None


def sizes_by_effect(
    found: SearchResult,
    slope: np.ndarray,
    size_of: Callable[..., EffectSize],
    model_error: float | np.ndarray = 0.0,
) -> dict[str, tuple[EffectSize, EffectSize]]:
    """Return the sizes of the named effects, see `Source.sizes`.

    `slope` (..., K) are derivatives of the flights' errors by the K named parameters; for `size_of`
    see `upper_size`. The model's own numerical error may change the parameters by `model_error`
    (K,); this is subtracted before the upper end is computed.
    """
    entries, intervals = found.last.evidence.space.entries, found.judged.intervals(found.indices)
    width, factor = intervals.half_width, intervals.factor()
    change = (found.estimate.theta - found.start.theta)[found.indices]
    certain = less_error(change, model_error)
    error, sizes = np.broadcast_to(model_error, change.shape), {}
    effects = np.array([entries[index].effect for index in found.indices])
    columns_of = {named.candidate.name: effects == named.candidate.name for named in found.named}
    for name, columns in (columns_of | {TOGETHER: np.ones(len(effects), bool)}).items():
        own_slope = slope[..., columns]
        upper = size_of(0.0 * own_slope[..., 0])
        if beyond_error(change[columns], error[columns], width[columns]):
            upper = upper_size(own_slope, certain[columns], factor[columns], size_of)
        sizes[name] = (size_of(own_slope @ change[columns]), upper)
    return sizes


@dataclass(frozen=True)
class DiagnosisInput:
    """The input of a diagnosis."""

    logs: Sequence[FlightLog]
    vehicle: Vehicle
    references: Sequence[FlightLog]
    """Flights of the same vehicle before a change."""
    drive: str
    """What drives the model: "commands", "motors" (measured rotor speeds) or "auto"."""
    integrator: str
    """Integration of the flights' bodies: "continuous", "euler" (MuJoCo's steps) or "auto"."""
    say: Callable[[str], None]
    """Receives a line of progress for people."""
    limits: Thresholds
    chosen: bool
    """Whether the source was chosen by name; then it raises an error if it cannot be used."""


@dataclass(frozen=True)
class SourceSet:
    """The sources of evidence that flights allow."""

    sources: tuple[Source, ...]
    """Empty if the flights allow none, for the reason in `warnings`."""
    held_out: Sequence[str]
    """Names of held-out flights or stretches."""
    driven_by: str
    """Signals that drive the model, for people."""
    warnings: Sequence[str] = ()
    tested: tuple[TestedEffect, ...] = ()
    """Effects that separate tests of the flights have named."""
    references: tuple[str, ...] = ()
    """Names of the flights before a change that are used, if a change is searched for."""
    compares: str | None = None
    """For people, if a change is searched for: how flights of the unchanged vehicle differ."""


@dataclass(frozen=True, eq=False)
class Finding:
    """Result of the steps of a diagnosis (`examine.py`) for one source; equal only to itself."""

    source: Source
    search: SearchResult
    """Result of its search, with the effects that passed the tests."""
    names: tuple[NamedEffect, ...]
    """Named effects after the comparison with other sources."""
    before: Gap
    """Gap of the given vehicle."""
    after: Gap
    """Gap with the named effects."""
    without: Mapping[str, Gap]
    """Gap without each named effect but with all others, by the label of the left-out effect."""
    half_width: Mapping[int, float]
    """Half-width of the 95 % interval, by the index of each named parameter."""
    sizes: Mapping[str, EffectSize]
    """Size of each named effect on these flights."""
    negligible: tuple[tuple[str, EffectSize], ...]
    """Significant effects that are too small to be relevant."""
    remaining: Remaining
    control: tuple[str, Gap] | None = None
    """Label and gap of a wrong effect that was fitted in the same way, for comparison."""

    @property
    def theta(self) -> np.ndarray:
        """(P,) all parameters, as fitted."""
        return self.search.estimate.theta

    def removed(self, names: Sequence[NamedEffect]) -> float:
        """Return the share of the gap that `names`, all of one effect, remove when added last."""
        without = max(self.without[named.candidate.label].rms for named in names)
        total = max(self.before.rms - self.before.floor, LEAST_GAP)
        return min(max((without - self.after.rms) / total, 0.0), 1.0)

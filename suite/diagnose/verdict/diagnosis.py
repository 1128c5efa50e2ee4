"""All that a diagnosis knows when it is done, and which of its names stand.

What held-out flights do not want is withdrawn.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.whitening import make_whitening
from suite.diagnose.data.windows import FlightWindows, cut
from suite.diagnose.estimate.block import Estimate
from suite.diagnose.estimate.parameters import Candidate, ParameterSpace, effects_in, indices_of
from suite.diagnose.evidence.rollouts import RolloutModel, block_of
from suite.diagnose.search.look import NamedEffect, SearchResult, rollouts_of
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.disturbances import Turbulence
from suite.diagnose.verdict.gap import HEADLINE_S, Gap, Verdict, measure, true_starts
from suite.diagnose.verdict.relevance import EffectSize, Negligible
from suite.diagnose.verdict.residual_structure import ResidualStructure


@dataclass(frozen=True)
class Diagnosis:
    """What was found, and what it was found from."""

    verdict: Verdict
    search: SearchResult
    half_width: dict[int, float]
    """Of the 95 % interval, by the place of each named number."""
    vehicle: Vehicle
    """With the named effects in place of what the nominal one has of them."""
    before: Gap
    after: Gap
    without: dict[str, Gap]
    """By a named effect's label: the gap with all others."""
    control: tuple[str, Gap] | None
    """A wrong effect fitted in the same way, and its gap."""
    residual: ResidualStructure
    """Structure in what the named effects leave."""
    turbulence: Turbulence | None
    logs: Sequence[FlightLog]
    nominal: Vehicle
    """The vehicle that the simulation used."""
    rotor_input: bool
    """Whether measured rotor speeds were the model's input, not the commands."""
    sizes: dict[str, EffectSize]
    """What each named effect does on these flights, by its name."""
    negligible: list[Negligible]
    """What is significant and too small to matter."""
    held_out: list[str]
    """Names of what took no part in finding or fitting anything."""
    held_windows: FlightWindows
    """Overlapping windows over it."""
    model: RolloutModel
    """Of the nominal vehicle."""
    seconds: float
    warnings: list[str]
    seed: int
    """Of all draws."""
    limits: Thresholds = THRESHOLDS

    @property
    def label(self) -> str:
        """no_gap, named, partly or unknown."""
        return self.verdict.label

    @property
    def results(self) -> tuple[Diagnosis]:
        """What each kind of evidence found: here one did."""
        return (self,)

    @property
    def names(self) -> tuple[NamedEffect, ...]:
        """Every name that stands."""
        return self.search.named

    @property
    def named(self) -> list[tuple[Diagnosis, NamedEffect]]:
        """Every name that stands, with what found it."""
        return [(self, name) for name in self.search.named]

    @property
    def space(self) -> ParameterSpace:
        """The catalogue's numbers."""
        return self.model.space

    def removed(self, names: Sequence[NamedEffect]) -> float:
        """Return the share of the gap that `names`, of one effect, take away when added last."""
        without = max(self.without[one.candidate.label].rms for one in names)
        return (without - self.after.rms) / max(self.before.rms - 1.0, 1e-9)

    def size(self, names: Sequence[NamedEffect]) -> tuple[EffectSize]:
        """Return what `names`, of one effect, do on these flights."""
        return (self.sizes[names[0].candidate.name],)

    @property
    def sigma(self) -> np.ndarray:
        """(19,) measurement noise of each channel in its unit; NaN where nothing was measured."""
        return rollouts_of(self.search.last).noise.sigma

    @property
    def input_source(self) -> str:
        """What the model's input was, for people."""
        return "measured rotor speeds" if self.rotor_input else "commands"

    @property
    def start(self) -> np.ndarray:
        """Return the numbers (P,) of the vehicle file."""
        return self.model.space.array("start")

    @property
    def fitted(self) -> np.ndarray | None:
        """Return the numbers (P,) with what was named; None where nothing was."""
        return self.search.estimate.theta if self.search.named else None

    def cut(self, stride_s: float, only: Sequence[int] | None = None) -> FlightWindows:
        """Return windows of all flights or of `only` some, one every `stride_s` [s]."""
        how = (self.rotor_input, stride_s, self.limits, self.model.integrator)
        windows, _ = cut(self.logs, self.nominal, *how, only=only)
        assert windows is not None  # the diagnosis has cut them before
        return windows


def confirmed(
    model: RolloutModel,
    found: SearchResult,
    held: FlightWindows,
    gaps: tuple[Gap, Gap],
    limits: Thresholds,
) -> tuple[SearchResult, Gap, dict[str, Gap], list[str]]:
    """Return `found` without the names that do not lower the gap on held-out flights.

    Where the model stays off the noise floor, what it lacks lends a part of itself to any number:
    a name has to lower the gap by a share of what is left then. A name stays where these flights
    could not show it, as those that keep off the ground cannot show its effect. `gaps` are those
    before and after it was found.

    Returns:
        What stays, its gap, the gaps without each of its names, and the labels of what went.
    """
    (before, after), gone = gaps, list[str]()
    while found.named:
        without = _without_each(model, found, held, limits)
        # Of the mean score, 1 is noise and all else what no name explains.
        rest = max(0.0, 1.0 - 1.0 / after.score.mean()) if rollouts_of(found.judged).off else 0.0
        doubted = [
            one
            for one in found.candidates
            if without[one.label].energy.sum()
            <= (1.0 + limits.least_beside_rest * rest) * after.energy.sum()
            and _shown(model, found, one, held, limits)
        ]
        if not doubted:
            return found, after, without, gone
        label = min((one.label for one in doubted), key=lambda k: float(without[k].energy.sum()))
        gone.append(label)
        kept = tuple(one for one in found.named if one.candidate.label != label)
        if kept:
            found = found.refitted(kept)
            kept = _acting(found)
        if not kept:
            return found.refitted(()), before, {}, gone
        if len(kept) < len(found.named):
            gone += [one.candidate.label for one in found.named if one not in kept]
            found = found.refitted(kept)
        after = measure(model, found.estimate.theta, held, rollouts_of(found.last).noise, limits)
    return found, after, {}, gone


def control(
    model: RolloutModel, found: SearchResult, held: FlightWindows, limits: Thresholds
) -> tuple[str, Gap] | None:
    """Return the best effect that is neither named nor a rival, fitted alone, and its gap."""
    taken = {candidate.name for candidate in found.candidates}
    taken |= {name for one in found.named for rival in one.rivals for name in effects_in(rival)}
    among = (s.candidate for s in found.first if not s.candidate.parts)
    wrong = next((one for one in among if one.name not in taken), None)
    if wrong is None:
        return None
    theta = found.fitted_anew(found.start, list(wrong.indices)).theta
    return wrong.label, measure(model, theta, held, rollouts_of(found.last).noise, limits)


def _acting(found: SearchResult) -> tuple[NamedEffect, ...]:
    """Return the names of `found` that do something: a wind without its drag does not."""
    told = np.einsum("wkk->k", found.judged.equations.along_numbers(found.indices).hessian)
    at = {index: told[k] for k, index in enumerate(found.indices)}
    return tuple(
        one for one in found.named if any(at[index] > 0.0 for index in one.candidate.indices)
    )


def _shown(
    model: RolloutModel,
    found: SearchResult,
    one: Candidate,
    held: FlightWindows,
    limits: Thresholds,
) -> bool:
    """Return whether held-out flights would show the effect at the size that was fitted."""
    theta, own = found.estimate.theta, list(one.indices)
    offset = true_starts(model, theta, held)
    linear = model.linearise(theta, offset, held, [*own, *model.starts])
    whitening = make_whitening(linear, rollouts_of(found.last).noise, held, limits)
    slope = block_of(whitening, linear, own, held).slope
    moved = theta[own] - model.space.array("start")[own]
    # Windows overlap: each row of the log counts this often.
    expected = float(((slope @ moved) ** 2).sum()) * limits.gap_stride_s / HEADLINE_S
    return bool(expected > limits.shown_chi2)


def _without_each(
    model: RolloutModel, found: SearchResult, held: FlightWindows, limits: Thresholds
) -> dict[str, Gap]:
    """Return by label of each name the gap where all others are fitted without it."""
    start, gaps = model.space.array("start"), {}
    for one in found.candidates:
        others = [candidate for candidate in found.candidates if candidate is not one]
        theta = start
        if others:
            theta = found.estimate.theta.copy()
            theta[list(one.indices)] = start[list(one.indices)]
            without = Estimate(theta, found.estimate.free)
            theta = found.fitted_anew(without, indices_of(others)).theta
        gaps[one.label] = measure(model, theta, held, rollouts_of(found.last).noise, limits)
    return gaps

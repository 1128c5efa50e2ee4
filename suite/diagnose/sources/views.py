"""Makes the sources of evidence `force` and `torque` from flights.

Each belongs to one view (part of the dynamics), and compares mean accelerations of the flights with
the vehicle file. If reference flights (earlier flights of the same vehicle) are given, they search
for a change since these instead. The means of whole flights are compared first. If no mean has
changed, the fallback searches for a change that shows only in motion.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.data.flights import ViewFlights, ready
from suite.diagnose.data.hold_out import choose_held_out, parted
from suite.diagnose.data.inertial import UNSEEN, is_inertial
from suite.diagnose.estimate.composites import composites
from suite.diagnose.estimate.gauss_newton import TINY
from suite.diagnose.estimate.parameters import Candidate, candidates
from suite.diagnose.evidence.view_means import ForceModel
from suite.diagnose.evidence.views import ViewEvidence, view_candidates
from suite.diagnose.search.change import (
    RotorSpread,
    change_evidence,
    deviations,
    less_reference_residual,
    rotor_spread,
    search_motion_change,
)
from suite.diagnose.search.evaluation import SearchResult
from suite.diagnose.sources.source import FITTED, GIVEN, DiagnosisInput, Series, SourceSet
from suite.diagnose.sources.view_source import NO_AGREEMENT, QUANTITIES, Shares, ViewSource
from suite.diagnose.verdict.actuators import find_rotor_lag

BASE_S, ROW_S = 5.0, 4e-4
"""Estimated duration on two cores: fixed part, and for each row [s]."""
MEASURE = (
    "RMS over the axes of the residual of {about} on held-out flights [{unit}], both "
    "sides smoothed over {width:g} s, without each flight's constant offset"
)
MEANS_MEASURE = (
    "RMS over the axes of the residual of {about} on held-out flights [{unit}], as the mean of "
    "each flight less the mean of the reference flights"
)
UNTESTED = "a change that depends on the motion, such as a drag, was not tested: {}"
"""Warning if only constant changes since reference flights are tested."""


def by_views(given: DiagnosisInput) -> SourceSet:
    """Make the sources force and torque; flights may lack signals.

    Raises:
        ValueError: if flights cannot be used, or there is only one reference flight.
    """
    # Smooth the flights, and set up the model and the effects that the search tries.
    vehicle, limits, references = given.vehicle, given.limits, given.references
    flights = ready(given.logs, vehicle, limits, given.references)
    logs = flights.logs
    voltage = all(log.voltage is not None for log in [*logs, *references])
    model = ForceModel(vehicle, voltage)
    allowed, not_shown = candidates(model.space, voltage, ()), list[str]()
    # Flights without a position (inertial logs) do not show wind.
    if any(is_inertial(log) for log in [*logs, *references]):
        allowed = [one for one in allowed if EFFECTS[one.name].wind is None]
        limits = replace(limits, least_view_share=limits.least_inertial_share)
        not_shown = [f"without a position these flights do not show {what}" for what in UNSEEN]
    evidence = {
        view.name: ViewEvidence(view, model, flights.smoothed[view.name], limits=limits)
        for view in flights.views
    }
    # `before` are the reference flights, and `earlier` is their evidence by view.
    before, spread = references_of(given, flights), None
    earlier = dict[str, ViewEvidence]()
    if before:
        earlier = {n: replace(one, flights=before.smoothed[n]) for n, one in evidence.items()}
        spread = rotor_spread([*earlier.values(), *evidence.values()])
    rows = min(sum(len(log.time_s) for log in logs), limits.most_rows)
    about = ", ".join(view.about for view in flights.views)
    given.say(f"views: {about}; by {flights.source}; {rows} rows: "
              f"about {BASE_S + rows * ROW_S:.0f} s")  # fmt: skip
    # Choose the held-out flights by their information, so that the fitted flights keep enough.
    first = evidence[flights.views[0].name]
    block = first.estimate_noise(first.start).block
    information = (block.slope**2).sum(axis=1)
    start_s = np.zeros(len(information))
    is_fitted, _ = choose_held_out(logs, block.flight, start_s, information, limits)
    held_numbers = sorted({*block.flight.tolist()} - {*block.flight[is_fitted].tolist()})
    fitted, held, held_names, notes = parted(flights, held_numbers, limits)
    # Of partial logs or a single flight to fit, only the means of flights are compared.
    untested = list[str]()
    if references and any(log.partial for log in [*logs, *references]):
        untested = [UNTESTED.format("some logs are partial")]
    elif references and len(next(iter(fitted.values()))) < 2:
        untested = [UNTESTED.format("this needs 3 new flights or more, as one is held out")]
    sources = []
    for name in fitted:
        one = evidence[name]
        to_fit, held_out = (replace(one, flights=part[name]) for part in (fitted, held))
        view, unit = one.view, "m/s^2" if one.view.in_world else "rad/s^2"
        shared: dict[str, Any] = {
            "name": name,
            "about": view.about,
            "subject": f"error of the {name}",
            "unit": unit,
            "measure": MEASURE.format(about=view.about, unit=unit, width=view.width_s),
            "horizon_s": view.width_s,
            "view": view,
            "limits": limits,
            "floor": flights.floor[name],
        }
        if spread is not None:
            sources.append(
                since_reference(
                    earlier[name], to_fit, held_out, spread, allowed, bool(untested), shared
                )
            )
            continue
        begin = to_fit.estimate_noise(to_fit.start)
        tried = view_candidates([*allowed, *composites(allowed)], begin.block)
        whole = one if one.view.in_world else None
        sources.append(
            ViewSource(begin=begin, candidates=tried, held=held_out, all_flights=whole, **shared)
        )
    lag = None if references else find_rotor_lag(logs, vehicle, limits)
    return SourceSet(
        tuple(sources),
        held_names,
        flights.source,
        (*notes, *not_shown, *(before.notes if before else ()), *untested),
        (lag,) if lag else (),
        tuple(log.name for log in before.logs) if before else (),
        spread.words if spread else None,
    )


@dataclass(frozen=True, kw_only=True)
class MeansSource(ViewSource):
    """Source for a change of the mean acceleration of whole flights since reference flights.

    Its noise floor is how the means of the reference flights differ.
    """

    reference: ViewEvidence
    """The reference flights."""
    reason = NO_AGREEMENT
    block = 1  # means of flights are independent
    window = "means of whole flights"

    def _within(self, residual: np.ndarray, flight: np.ndarray) -> np.ndarray:
        """Return the means, from which nothing is subtracted."""
        return residual

    def _shares(self, found: SearchResult) -> Shares:
        """Return the shares that the named effects explain; a black box has nothing to explain."""
        before, after = (
            (self.held.residuals(at.theta).residual ** 2).mean(axis=0)
            for at in (found.start, found.estimate)
        )
        closed = 1.0 - after / np.maximum(before, TINY)
        evidence = found.last.evidence
        assert isinstance(evidence, ViewEvidence)
        spread = evidence.repeatability
        return Shares(closed, np.maximum(closed, 0.0), np.zeros(3), before, spread)

    def series(self, found: SearchResult) -> Series:
        """Return the means of all flights along the axis that the named effects change most."""
        start, end = found.start.theta, found.estimate.theta
        earlier = deviations(self.reference, start)
        change, left = (self.held.residuals(theta).residual for theta in (start, end))
        size = np.abs(change - left if found.named else change).mean(axis=0)
        axis = max(self.view.axes, key=lambda k: float(size[k]))
        count, zeros = len(earlier), np.zeros(len(earlier) + len(change))
        lines = {GIVEN: zeros}
        if found.named:
            lines[FITTED] = np.append(zeros[:count], (change - left)[:, axis])
        quantity = QUANTITIES[self.name]
        return Series(
            1.0 + np.arange(len(zeros)),
            np.concatenate([earlier, change])[:, axis],
            lines,
            f"Change of the mean {quantity} along body {'xyz'[axis]} [{self.unit}]",
            f"Each point is the mean of a flight, less the mean of the {count} reference flights: "
            f"flights 1 to {count} are the reference flights, the others the held-out ones.",
            x_label="flight",
        )


@dataclass(frozen=True, kw_only=True)
class MotionSource(ViewSource):
    """Source for a change since reference flights that shows only in motion."""

    reference: ViewEvidence
    """The reference flights, before the change."""
    fitted: ViewEvidence
    """The flights after the change."""
    views: int
    """Number of views that are searched; the search corrects for it."""

    def search(self, say: Callable[[str], None], seed: int) -> SearchResult:
        """Search for an effect that has changed since the reference flights, see `Source`."""
        found = search_motion_change(self.reference, self.fitted, self.candidates, self.views)
        return found or SearchResult((), self.start, self.begin, self.begin, [])


def since_reference(
    reference: ViewEvidence,
    evidence: ViewEvidence,
    held: ViewEvidence,
    spread: RotorSpread,
    allowed: Sequence[Candidate],
    means_only: bool,
    shared: dict[str, Any],
) -> ViewSource:
    """Return the source that searches for a change since the `reference` flights.

    `evidence` has the flights to fit, `held` the held-out ones; `shared` are fields of all sources.
    """
    begin = change_evidence(reference, evidence.flights, spread)
    theta = begin.at.theta
    shared = {**shared, "begin": begin, "names_small": True, "reference": reference}
    in_motion = MotionSource(
        candidates=allowed, held=held, fitted=evidence, views=len(spread.along), **shared
    )
    means = replace(less_reference_residual(reference, theta, held.flights), means=True)
    # The floor is the standard deviation of the mean of a flight of an unchanged vehicle.
    usual = deviations(reference, theta)
    shared |= {
        "measure": MEANS_MEASURE.format(about=shared["about"], unit=shared["unit"]),
        "floor": usual.std(axis=0, ddof=1) * np.sqrt(1.0 + 1.0 / len(usual)),
    }
    return MeansSource(
        candidates=view_candidates(allowed, begin.block),
        held=means,
        fallback=None if means_only else in_motion,
        **shared,
    )


def references_of(given: DiagnosisInput, flights: ViewFlights) -> ViewFlights | None:
    """Return the usable reference flights, if any are given; `flights` are the other flights.

    Raises:
        ValueError: if less than two are usable, or their signals differ from the other flights'.
    """
    if not given.references:
        return None
    before = ready(given.references, given.vehicle, given.limits, given.logs)
    if len(before.logs) < 2:
        words = (
            f"--reference has {len(before.logs)} flight; at least 2 are needed, better 3, to "
            "estimate how flights of one vehicle differ"
        )
        raise ValueError("; ".join([words, *before.notes]))
    if before.views != flights.views or before.source != flights.source:
        raise ValueError(
            f"the reference flights are driven by {before.source} and allow "
            f"{_view_words(before)}, the others by {flights.source} and {_view_words(flights)}: "
            "log the same signals in both"
        )
    return before


def _view_words(flights: ViewFlights) -> str:
    """Return a text with the views of flights, their axes and the width of their windows."""
    return " and ".join(
        f"{view.name} (along {''.join('xyz'[k] for k in view.axes)}, means of {view.width_s:g} s)"
        for view in flights.views
    )

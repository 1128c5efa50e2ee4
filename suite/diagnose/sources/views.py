"""Makes the sources of evidence `force` and `torque` from flights.

Each belongs to one view (part of the dynamics), and compares mean accelerations of the flights with
the vehicle file. If reference flights of the same vehicle are given, they search for a change since
the reference flights instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.data.flights import ViewFlights, ready
from suite.diagnose.data.hold_out import choose_held_out, parted
from suite.diagnose.data.inertial import UNSEEN, is_inertial
from suite.diagnose.data.view import View
from suite.diagnose.estimate.composites import composites
from suite.diagnose.estimate.parameters import Candidate, candidates, make_space
from suite.diagnose.evidence.moments import ForceModel
from suite.diagnose.evidence.views import ViewEvidence, view_candidates
from suite.diagnose.search.change import (
    RotorSpread,
    change_evidence,
    less_reference_residual,
    rotor_spread,
)
from suite.diagnose.sources.source import DiagnosisInput, Source, SourceSet
from suite.diagnose.sources.view_source import MotionSource, ViewSource
from suite.diagnose.verdict.actuators import find_rotor_lag

BASE_S, ROW_S = 5.0, 4e-4
"""Estimated duration on two cores: fixed part, and for each row [s]."""
MEASURE = (
    "RMS over the axes of the residual of {about} on held-out flights [{unit}], both "
    "sides smoothed over {width:g} s"
)
OFFSETS = ", without each flight's constant offset"
"""End of the definition, except where means of flights are compared."""


def by_views(given: DiagnosisInput, before: Sequence[Source]) -> SourceSet | None:
    """Make the sources force and torque; flights may lack signals.

    Args:
        given: the input of the diagnosis.
        before: sources that exist already.

    Returns:
        The sources, or None if other sources exist and these were not chosen by name.

    Raises:
        ValueError: if flights cannot be used, or there is only one reference flight.
    """
    if before and not given.chosen:
        return None
    # Smooth the flights, and set up the model and the effects that the search tries.
    vehicle, limits, references = given.vehicle, given.limits, given.references
    flights = ready(given.logs, vehicle, limits, given.references)
    logs = [given.logs[k] for k in flights.kept]
    space = make_space(vehicle)
    voltage = all(log.voltage is not None for log in [*logs, *references])
    model = ForceModel(vehicle, space, voltage)
    allowed, not_shown = candidates(space, voltage, ()), list[str]()
    # Flights without a position (inertial logs) do not show wind.
    if any(is_inertial(log) for log in [*logs, *references]):
        allowed = [one for one in allowed if EFFECTS[one.name].wind is None]
        limits = replace(limits, least_view_share=limits.least_inertial_share)
        not_shown = [f"without a position these flights do not show {what}" for what in UNSEEN]
    evidence = {
        view.name: ViewEvidence(view, model, flights.smoothed[view.name], limits)
        for view in flights.views
    }
    # `earlier` is the evidence of the reference flights by view; empty if there are none.
    earlier, spread, left_out = _references(given, flights, evidence)
    rows = min(sum(len(log.time_s) for log in logs), limits.most_rows)
    about = ", ".join(view.about for view in flights.views)
    given.say(f"views: {about}; by {flights.source}; {rows} rows: "
              f"about {BASE_S + rows * ROW_S:.0f} s")  # fmt: skip
    # Choose the held-out flights by their information, so that the fitted flights keep enough.
    first = evidence[flights.views[0].name]
    block = first.estimate_noise(first.start)[1]
    information = (block.slope**2).sum(axis=1)
    start_s = np.zeros(len(information))
    is_fitted, _ = choose_held_out(logs, block.flight, start_s, information, limits)
    held_numbers = sorted({*block.flight.tolist()} - {*block.flight[is_fitted].tolist()})
    fitted, held, held_names = parted(flights, held_numbers, limits)
    # Make one source for each view.
    sources = []
    for name, one in evidence.items():
        to_fit, held_out = (replace(one, flights=part[name]) for part in (fitted, held))
        shared: dict[str, Any] = {
            **_descriptions(one.view),
            "limits": limits,
            "floor": flights.floor[name],
        }
        if spread is not None:
            # Of logs that lack a required signal only the means of flights are compared.
            partial = any(log.partial for log in [*logs, *references])
            sources.append(
                _since_reference(earlier[name], to_fit, held_out, spread, allowed, partial, shared)
            )
            continue
        weighed = to_fit.estimate_noise(to_fit.start)
        tried = view_candidates([*allowed, *composites(allowed)], weighed[1])
        whole = one if one.view.in_world else None
        sources.append(
            ViewSource(
                weighed=weighed, start=to_fit.start, candidates=tried, held=held_out,
                all_flights=whole, **shared,
            )
        )  # fmt: skip
    lag = None if references else find_rotor_lag(logs, vehicle, limits)
    return SourceSet(
        tuple(sources),
        held_names,
        flights.source,
        (*flights.notes, *not_shown, *left_out),
        (lag,) if lag else (),
        _spread_words(spread, len(references)),
    )


def _descriptions(view: View) -> dict[str, Any]:
    """Return the fields of a source that depend only on its view, by name."""
    about = {"about": view.about, "unit": view.unit}
    measure = MEASURE.format(**about, width=view.width_s) + OFFSETS
    return {
        **about, "name": view.name, "view": view, "horizon_s": view.width_s, "measure": measure,
        "subject": f"error of the {view.name}",
    }  # fmt: skip


def _since_reference(
    reference: ViewEvidence,
    evidence: ViewEvidence,
    held: ViewEvidence,
    spread: RotorSpread,
    allowed: Sequence[Candidate],
    means_only: bool,
    shared: dict[str, Any],
) -> ViewSource:
    """Return the source that searches for a change since the `reference` flights.

    It compares means of flights. If no mean has changed, its fallback searches for a change that
    shows only in motion.

    Args:
        reference: the flights before the change.
        evidence: the flights to fit.
        held: the held-out flights.
        spread: how much the rotors' thrusts vary between the flights of one vehicle.
        allowed: effects that the search may try.
        means_only: whether there is no fallback.
        shared: fields of both sources.
    """
    difference, start = change_evidence(reference, evidence.flights, spread)
    weighed = difference.relinearise(start)
    shared = {**shared, "weighed": weighed, "start": start, "names_small": True}
    in_motion = MotionSource(
        candidates=allowed, held=held, reference=reference, fitted=evidence,
        views=len(spread.along), **shared,
    )  # fmt: skip
    means = replace(less_reference_residual(reference, start.theta, held.flights), means=True)
    compared = view_candidates(allowed, weighed[1])
    shared["measure"] = shared["measure"].removesuffix(OFFSETS)
    fallback = None if means_only else in_motion
    return ViewSource(candidates=compared, held=means, fallback=fallback, **shared)


def _spread_words(spread: RotorSpread | None, count: int) -> tuple[str, ...]:
    """Return a text for people on how much the `count` reference flights differ, if any."""
    if spread is None:
        return ()
    return (
        f"The {count} reference flights differ as if each rotor's thrust varied by "
        f"{100 * spread.share:.1f} % from flight to flight ({spread.freedom} degrees of freedom). "
        "The differences along each axis count as well. A change is named if it exceeds these "
        "differences significantly.",
    )


def _references(
    given: DiagnosisInput, flights: ViewFlights, evidence: Mapping[str, ViewEvidence]
) -> tuple[dict[str, ViewEvidence], RotorSpread | None, tuple[str, ...]]:
    """Prepare the reference flights, to be compared with `flights` and their `evidence` by view.

    Returns:
        Their evidence by view, the spread between flights, and a note for each unusable flight.

    Raises:
        ValueError: if less than two are usable, or their signals differ from the other flights'.
    """
    if not given.references:
        return {}, None, ()
    before = ready(given.references, given.vehicle, given.limits, given.logs)
    if len(before.names) < 2:
        raise ValueError(
            "; ".join(
                [
                    f"--reference has {len(before.names)} flight; at least 2 are needed, better 3, "
                    "to estimate how flights of one vehicle differ",
                    *before.notes,
                ]
            )
        )
    if before.views != flights.views or before.source != flights.source:
        raise ValueError(
            f"the reference flights are driven by {before.source} and allow "
            f"{_view_words(before)}, the others by {flights.source} and {_view_words(flights)}: "
            "log the same signals in both"
        )
    earlier = {n: replace(one, flights=before.smoothed[n]) for n, one in evidence.items()}
    return earlier, rotor_spread([*earlier.values(), *evidence.values()]), before.notes


def _view_words(flights: ViewFlights) -> str:
    """Return a text with the views of flights, their axes and the width of their windows."""
    return " and ".join(
        f"{view.name} (along {''.join('xyz'[k] for k in view.axes)}, means of {view.width_s:g} s)"
        for view in flights.views
    )

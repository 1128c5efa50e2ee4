"""Makes the sources of evidence `force` and `torque` from flights.

Each belongs to one view (part of the dynamics), and compares mean accelerations of the flights with
the vehicle file. If reference flights of the same vehicle are given, they search for a change since
the reference flights instead.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.data.flights import ready
from suite.diagnose.data.hold_out import choose_held_out, parted
from suite.diagnose.data.inertial import UNSEEN, is_inertial
from suite.diagnose.data.view import View
from suite.diagnose.estimate.composites import composites
from suite.diagnose.estimate.parameters import candidates, make_space
from suite.diagnose.evidence.moments import ForceModel
from suite.diagnose.evidence.views import ViewEvidence, view_candidates
from suite.diagnose.sources.change import references_of, since_reference, spread_words
from suite.diagnose.sources.source import DiagnosisInput, SourceSet
from suite.diagnose.sources.view_source import ViewSource
from suite.diagnose.verdict.actuators import find_rotor_lag

BASE_S, ROW_S = 5.0, 4e-4
"""Estimated duration on two cores: fixed part, and for each row [s]."""
MEASURE = (
    "RMS over the axes of the residual of {about} on held-out flights [{unit}], both "
    "sides smoothed over {width:g} s, without each flight's constant offset"
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
    earlier, spread, left_out = references_of(given, flights, evidence)
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
    parts = parted(flights, held_numbers, limits)
    # Of partial logs or a single flight to fit, only the means of flights are compared.
    untested = list[str]()
    if references and any(log.partial for log in [*logs, *references]):
        untested = [UNTESTED.format("some logs are partial")]
    elif references and len(next(iter(parts.fitted.values()))) < 2:
        untested = [UNTESTED.format("this needs 3 new flights or more, as one is held out")]
    # Make one source for each view.
    sources = []
    for name in parts.fitted:
        one = evidence[name]
        to_fit, held_out = (replace(one, flights=p[name]) for p in (parts.fitted, parts.held))
        shared: dict[str, Any] = {
            **_descriptions(one.view),
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
        parts.names,
        flights.source,
        (*flights.notes, *parts.notes, *not_shown, *left_out, *untested),
        (lag,) if lag else (),
        spread_words(spread, len(references)),
    )


def _descriptions(view: View) -> dict[str, Any]:
    """Return the fields of a source that depend only on its view, by name."""
    about = {"about": view.about, "unit": "m/s^2" if view.in_world else "rad/s^2"}
    measure = MEASURE.format(**about, width=view.width_s)
    return {
        **about, "name": view.name, "view": view, "horizon_s": view.width_s, "measure": measure,
        "subject": f"error of the {view.name}",
    }  # fmt: skip

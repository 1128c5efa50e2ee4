"""Makes the sources `force` and `torque`, since the vehicle file or since reference flights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from eval.logs.flight_log import FlightLog
from suite.diagnose.data.flights import ViewFlights, choose_held_out, parted, ready
from suite.diagnose.data.inertial import UNSEEN, is_inertial
from suite.diagnose.data.view import FORCE, View
from suite.diagnose.estimate.composites import composites
from suite.diagnose.estimate.parameters import Candidate, candidates, make_space
from suite.diagnose.evidence.moments import ForceModel
from suite.diagnose.evidence.views import ViewEvidence, view_candidates
from suite.diagnose.search.chance import RotorSpread, rotor_spread
from suite.diagnose.search.change import changed, changed_task
from suite.diagnose.sources.source import Given, Source, Sources, TestedEffect
from suite.diagnose.sources.view_source import MotionSource, ViewSource
from suite.diagnose.thresholds import Thresholds
from suite.diagnose.verdict.actuators import LAG, RotorLag, another_lag

BASE_S, ROW_S = 5.0, 4e-4
"""Estimated duration on two cores: fixed part, and for each row [s]."""
MEASURE = (
    "RMS over the axes of the residual of {about} on held-out flights [{unit}], both "
    "sides smoothed over {width:g} s"
)


def by_views(given: Given, before: Sequence[Source]) -> Sources | None:
    """Return the sources force and torque of (also partial) flights; None where rollouts are used.

    With reference flights the sources are those of what has changed since.

    Raises:
        ValueError: for flights that cannot be used, or a lone reference flight.
    """
    if before and not given.chosen:
        return None
    vehicle, limits, references = given.vehicle, given.limits, given.references
    flights = ready(given.logs, vehicle, limits, given.references)
    logs = [given.logs[k] for k in flights.kept]
    space = make_space(vehicle)
    voltage = all(log.voltage is not None for log in [*logs, *references])
    model = ForceModel(vehicle, space, voltage)
    among, unseen = candidates(space, voltage, ()), list[str]()
    if any(is_inertial(log) for log in [*logs, *references]):
        among = [one for one in among if EFFECTS[one.name].wind is None]
        limits = replace(limits, least_view_share=limits.least_inertial_share)
        unseen = [f"without a position these flights do not show {what}" for what in UNSEEN]
    earlier, spread, left_out = _references(given, flights, model, limits)
    rows = min(sum(len(log.time_s) for log in logs), limits.most_rows)
    about = ", ".join(view.about for view in flights.views)
    given.say(f"views: {about}; by {flights.source}; {rows} rows: "
              f"about {BASE_S + rows * ROW_S:.0f} s")  # fmt: skip
    numbers, names = _held(logs, flights, model, limits)
    inside, held = parted(flights, numbers, limits)
    partial = any(log.partial for log in [*logs, *references])
    sources = []
    for view in flights.views:
        task = ViewEvidence(view, model, inside[view.name], limits)
        apart = replace(task, flights=held[view.name])
        floor = flights.floor[view.name]
        if spread is None:
            every = replace(task, flights=flights.smoothed[FORCE.name]) if view.in_world else None
            sources.append(_since_file(task, apart, every, among, floor))
        else:
            reference = earlier[view.name]
            one = _since_reference(reference, task, apart, spread, among, floor)
            sources.append(replace(one, otherwise=None) if partial else one)
    lag = None if references else another_lag(logs, vehicle, limits)
    return Sources(
        tuple(sources),
        names,
        flights.source,
        (*flights.notes, *unseen, *left_out),
        (_tested(lag),) if lag else (),
        _compared(spread, len(references)),
    )


def _tested(lag: RotorLag) -> TestedEffect:
    """Return the rotors' lag as a named effect: no view depends on it."""
    low, high = max(lag.time_constant - lag.half_width, 0.0), lag.time_constant + lag.half_width
    parameters = {
        "time_constant": {"value": lag.time_constant, "unit": "s", "ci95": [low, high]},
    }
    words = (
        f"{LAG}: the rotors follow their commands with a time constant of "
        f"{lag.time_constant:.3g} s instead of {lag.known:.3g} s."
    )
    values = EFFECTS[LAG].values(lag.time_constant)
    return TestedEffect(LAG, values, parameters, lag.closed, lag.p_value, "commands", words)


def _about(view: View) -> dict[str, Any]:
    about = {"about": view.about, "unit": view.unit}
    measure = MEASURE.format(**about, width=view.width_s)
    return {
        **about, "name": view.name, "view": view, "horizon_s": view.width_s, "measure": measure,
        "subject": f"error of the {view.name}",
    }  # fmt: skip


def _since_file(
    task: ViewEvidence,
    held: ViewEvidence,
    every: ViewEvidence | None,
    among: Sequence[Candidate],
    floor: np.ndarray,
) -> ViewSource:
    """Return the source of what the vehicle file lacks."""
    known = task.weighed(task.start)
    return ViewSource(
        known=known,
        start=task.start,
        among=view_candidates([*among, *composites(among)], known[1]),
        limits=task.limits,
        held=held,
        floor=floor,
        every=every,
        **_about(task.view),
    )


def _since_reference(
    reference: ViewEvidence,
    task: ViewEvidence,
    held: ViewEvidence,
    spread: RotorSpread,
    among: Sequence[Candidate],
    floor: np.ndarray,
) -> ViewSource:
    """Return the source of what has changed since the `reference` flights.

    Means of flights are compared; where none has changed, what shows in motion.
    """
    evidence, start = changed(reference, task.flights, spread)
    known = evidence.again(start)
    moved = MotionSource(
        known=known, start=start, among=among, limits=task.limits, held=held, floor=floor,
        keeps_small=True, reference=reference, fitted=task, **_about(task.view),
    )  # fmt: skip
    means = replace(changed_task(reference, start.theta, held.flights), means=True)
    return ViewSource(
        known=known, start=start, among=view_candidates(among, known[1]), limits=task.limits,
        held=means, floor=floor, keeps_small=True, otherwise=moved, **_about(task.view),
    )  # fmt: skip


def _compared(spread: RotorSpread | None, count: int) -> tuple[str, ...]:
    """Return in words how much reference flights differ."""
    if spread is None:
        return ()
    return (
        f"The {count} reference flights differ as though each rotor's thrust were off by "
        f"{100 * spread.share:.1f} % from flight to flight ({spread.freedom} degrees of freedom); "
        "along an axis its own differences count next to that. A change is named where it stands "
        "out of them.",
    )


def _references(
    given: Given, flights: ViewFlights, model: ForceModel, limits: Thresholds
) -> tuple[dict[str, ViewEvidence], RotorSpread | None, tuple[str, ...]]:
    """Return the reference flights by view, how they differ, and which were left out."""
    if not given.references:
        return {}, None, ()
    before = ready(given.references, given.vehicle, limits, given.logs)
    if len(before.names) < 2:
        raise ValueError(
            "; ".join(
                [
                    f"--reference has {len(before.names)} flight; at least 2 are needed, better 3: "
                    "how flights of one vehicle differ is taken from them",
                    *before.notes,
                ]
            )
        )
    if before.views != flights.views or before.source != flights.source:
        raise ValueError(
            f"the reference flights are driven by {before.source} and allow "
            f"{_allowed(before)}, the others by {flights.source} and {_allowed(flights)}: log both "
            "alike"
        )
    tasks = {
        view.name: ViewEvidence(view, model, before.smoothed[view.name], limits)
        for view in flights.views
    }
    after = [replace(task, flights=flights.smoothed[name]) for name, task in tasks.items()]
    return tasks, rotor_spread([*tasks.values(), *after]), before.notes


def _allowed(flights: ViewFlights) -> str:
    """Return in words which views, axes and means flights allow."""
    return " and ".join(
        f"{view.name} (along {''.join('xyz'[k] for k in view.axes)}, means of {view.width_s:g} s)"
        for view in flights.views
    )


def _held(
    logs: Sequence[FlightLog], flights: ViewFlights, model: ForceModel, limits: Thresholds
) -> tuple[list[int], list[str]]:
    """Return the numbers and the names of the flights that are held out."""
    view = flights.views[0]
    task = ViewEvidence(view, model, flights.smoothed[view.name], limits)
    block = task.weighed(task.start)[1]
    informed = (block.slope**2).sum(axis=1)
    _, names = choose_held_out(logs, block.flight, np.zeros(len(informed)), informed, limits)
    return [k for k, log in enumerate(logs) if log.name in names], names

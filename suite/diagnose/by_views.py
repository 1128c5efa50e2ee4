"""From real flights to what they say that a vehicle file lacks, one view at a time."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from eval.effects import EFFECTS
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.flights import ViewFlights, choose_held_out, parted, ready
from suite.diagnose.data.inertial import UNSEEN, is_inertial
from suite.diagnose.data.view import FORCE, View
from suite.diagnose.estimate.composites import composites
from suite.diagnose.estimate.parameters import (
    ParameterSpace,
    candidates,
    implausible,
    make_space,
    with_fitted,
)
from suite.diagnose.evidence.moments import ForceModel
from suite.diagnose.evidence.views import ViewBlock, ViewEvidence, view_candidates
from suite.diagnose.search.chance import RotorSpread, rotor_spread
from suite.diagnose.search.change import changed_task, search_change, search_motion_change
from suite.diagnose.search.look import NamedEffect, SearchResult, contradicted
from suite.diagnose.search.search import search
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.actuators import LAG, RotorLag, another_lag
from suite.diagnose.verdict.disturbances import Swing, swing_left
from suite.diagnose.verdict.relevance import EffectSize, Negligible, view_size
from suite.diagnose.verdict.view_gap import ViewGap, gap_without, judge

BASE_S, ROW_S = 5.0, 4e-4
"""About how long it takes, in all and a row more, on two cores [s]."""


@dataclass(frozen=True)
class ViewResult:
    """What one view found."""

    view: View
    search: SearchResult
    held: ViewEvidence
    """The flights that took no part in it."""
    gap: ViewGap
    names: tuple[NamedEffect, ...]
    """What of the search's names stands, beside the other views'."""
    half_width: dict[int, float]
    """Of the 95 % interval, by the place of each named number."""
    negligible: tuple[Negligible, ...] = ()
    """What is significant and too small to matter."""

    def left(self, by_axis: np.ndarray, limits: Thresholds) -> float:
        """Return the share of the variance that is left, 0 where that is too little to matter."""
        share = self.gap.share(by_axis)
        rms = float(np.sqrt(share * self.gap.variance.sum()))
        size = EffectSize(rms, 0.0, None) if self.view.in_world else EffectSize(0.0, rms, None)
        return share if size.relevant(limits) else 0.0

    def removed(self, names: Sequence[NamedEffect]) -> float:
        """Return the share of the gap that `names` take away when added last."""
        gap, indices = self.gap, sorted(i for name in names for i in name.candidate.indices)
        without = gap.rms(gap_without(self.search, self.held, indices))
        whole = gap.rms(gap.before) - gap.rms(gap.floor)
        return (without - gap.rms(gap.after)) / max(whole, 1e-9)

    def size(self, names: Sequence[NamedEffect]) -> tuple[EffectSize, EffectSize]:
        """Return what `names` do together in this view, and the upper end of its interval."""
        at = sorted({i for name in names for i in name.candidate.indices})
        last = self.search.last
        assert isinstance(last.block, ViewBlock)
        slope = last.block.data.slope[..., [last.block.along.index(i) for i in at]]
        away = (last.at.theta - self.search.start.theta)[at]
        wide = np.array([self.half_width[i] for i in at])
        doubt = np.sqrt(((slope * wide) ** 2).sum(axis=-1))
        inside = self.view.in_world
        size, more = view_size(slope @ away, inside), view_size(doubt, inside)
        return size, EffectSize(size.force + more.force, size.torque + more.torque, None)


@dataclass(frozen=True)
class ViewsDiagnosis:
    """What the views of real flights found."""

    label: str
    """no_gap, named, partly or unknown."""
    results: tuple[ViewResult, ...]
    """By view, in their order."""
    space: ParameterSpace
    flights: ViewFlights
    held_out: list[str]
    """Names of what took no part in finding or fitting."""
    vehicle: Vehicle
    """With what was named."""
    spread: RotorSpread | None
    """How the reference flights differ; None without."""
    references: tuple[str, ...]
    """Names of the reference flights."""
    warnings: list[str]
    seconds: float
    swing: Swing | None = None
    """In what the force view leaves with its names."""
    lag: RotorLag | None = None
    """Of the rotors, where it is not the given vehicle's."""
    limits: Thresholds = THRESHOLDS

    @property
    def input_source(self) -> str:
        """What is taken for the rotors' speeds."""
        return self.flights.source

    @property
    def main(self) -> ViewResult:
        """The view that says most: one that names something, else one where most can be said."""
        return max(
            self.results,
            key=lambda one: (bool(one.names), one.gap.share(one.gap.explainable)),
        )

    @property
    def named(self) -> list[tuple[ViewResult, NamedEffect]]:
        """Every name that stands, with its view."""
        return [(result, name) for result in self.results for name in result.names]


def diagnose_by_views(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    references: Sequence[FlightLog] = (),
    say: Callable[[str], None] = lambda _: None,
    seed: int = 0,
    limits: Thresholds = THRESHOLDS,
) -> ViewsDiagnosis:
    """Find what explains how `logs` differ from `vehicle`, or from `references` of it.

    Args:
        logs: flights, partial ones too; a fifth of them, at least one, is held out (of a lone
            flight the last 30 %).
        vehicle: what a simulation uses.
        references: flights of the same vehicle before what changed.
        say: told of the steps.
        seed: of the null's draws.
        limits: of every step.

    Raises:
        ValueError: for flights that cannot be used, or a lone reference flight.
    """
    began = time.monotonic()
    flights = ready(logs, vehicle, limits)
    logs = [logs[k] for k in flights.kept]
    space = make_space(vehicle)
    voltage = all(log.voltage is not None for log in [*logs, *references])
    model = ForceModel(vehicle, space, voltage)
    among = candidates(space, voltage, ())
    unseen: list[str] = []
    if any(is_inertial(log) for log in [*logs, *references]):
        among = [one for one in among if EFFECTS[one.name].wind is None]
        limits = replace(limits, least_view_share=limits.least_inertial_share)
        unseen = [f"without a position these flights do not show {what}" for what in UNSEEN]
    whole = not any(log.partial for log in [*logs, *references])
    known, spread, left_out = _reference_tasks(flights, model, vehicle, references, limits)
    rows, about = sum(len(log.time_s) for log in logs), ", ".join(v.about for v in flights.views)
    say(f"views: {about}; by {flights.source}; {rows} rows: about {BASE_S + rows * ROW_S:.0f} s")
    held_numbers, held_names = _held(logs, flights, model, limits)
    inside, held = parted(flights, held_numbers, limits)
    results = []
    for view in flights.views:
        task = ViewEvidence(view, model, inside[view.name], limits)
        if known and spread:
            found = search_change(known[view.name], task.flights, spread, among, seed)
            apart = changed_task(known[view.name], found.start.theta, held[view.name])
            apart = replace(apart, means=True)
            if whole and not found.named:
                moved = search_motion_change(known[view.name], task, among)
                if moved:
                    found, apart = moved, replace(task, flights=held[view.name])
        else:
            begun = task.weighed(task.start)
            seen = view_candidates([*among, *composites(among)], begun[1])
            found = search(begun[0], task.start, seen, say, seed, begun)
            for refused, words in contradicted(results[0].search, found) if results else ():
                text = f"{view.name}: {refused.label} is contradicted by {results[0].view.name}"
                unseen.append(f"{text} ({words}): left out")
                seen = [c for c in seen if not set(c.indices) & set(refused.indices)]
                found = search(begun[0], task.start, seen, say, seed, begun)
            apart = replace(task, flights=held[view.name])
        gap = judge(found, apart, flights.floor[view.name])
        widths = found.half_widths()
        width = dict(zip(found.indices, map(float, widths), strict=True))
        result = ViewResult(view, found, apart, gap, found.named, width)
        results.append(result if known else _relevant(result, limits))
        told = ", ".join(name.candidate.label for name in found.named) or "nothing"
        say(f"{view.name}: {told}; {100 * gap.share(gap.closed):.0f} % of the variance closed, "
            f"{100 * gap.share(gap.explainable):.0f} % by a black box")  # fmt: skip
    results, withdrawn = _confirmed(tuple(results))
    results, told = _one_cause(results)
    warnings = [*flights.notes, *unseen, *left_out, *withdrawn, *told]
    warnings += [
        f"{one.name}: left out, too small to matter: {one.size.words()}"
        for result in results
        for one in result.negligible
    ]
    for result in results:
        for name in result.names:
            far = implausible(space, result.search.estimate.theta, name.candidate, limits)
            warnings += [f"implausible: {one}, beyond three times what is usual" for one in far]
    swing = None
    for result in results:
        if result.view.name == FORCE.name and not references:
            every = ViewEvidence(result.view, model, flights.smoothed[FORCE.name], limits)
            swing = swing_left(every, result.search.estimate.theta)
    lag = None if references else another_lag(logs, vehicle, limits)
    if lag:
        say(f"commands and rotor speeds: {LAG}, {lag.time_constant:.3g} s")
    return ViewsDiagnosis(
        label=_verdict(results, swing, lag, limits),
        results=results,
        space=space,
        flights=flights,
        held_out=held_names,
        vehicle=_with_names(vehicle, space, results, lag),
        spread=spread,
        references=tuple(log.name for log in references),
        warnings=warnings,
        seconds=time.monotonic() - began,
        swing=swing,
        lag=lag,
        limits=limits,
    )


def _reference_tasks(
    flights: ViewFlights,
    model: ForceModel,
    vehicle: Vehicle,
    references: Sequence[FlightLog],
    limits: Thresholds,
) -> tuple[dict[str, ViewEvidence], RotorSpread | None, tuple[str, ...]]:
    """Return the reference flights' task by view, how they differ, and which were left out."""
    if not references:
        return {}, None, ()
    before = ready(references, vehicle, limits)
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
    """Return what flights allow, down to what may differ: axes, and the time of a mean."""
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
    told = (block.slope**2).sum(axis=1)
    _, names = choose_held_out(logs, block.flight, np.zeros(len(told)), told, limits)
    return [k for k, log in enumerate(logs) if log.name in names], names


def _confirmed(results: tuple[ViewResult, ...]) -> tuple[tuple[ViewResult, ...], list[str]]:
    """Return the results without names that make held-out flights worse, and warnings of them."""
    kept, warnings = [], []
    for one in results:
        gap = one.gap
        # Each flight's own trim weighs more on a lighter body: what is closed within flights counts
        # as well, unless means are all that is looked at.
        worse = gap.rms(gap.after) >= gap.rms(gap.before)
        if one.names and worse and (one.held.means or gap.share(gap.closed) <= 0.0):
            labels = ", ".join(name.candidate.label for name in one.names)
            warnings.append(
                f"{one.view.name}: {labels}: withdrawn, held-out flights are no better for it"
            )
            nothing = one.search.refitted(())
            gap = judge(nothing, one.held, gap.floor)
            one = replace(one, search=nothing, gap=gap, names=(), half_width={})
        kept.append(one)
    return tuple(kept), warnings


def _relevant(result: ViewResult, limits: Thresholds) -> ViewResult:
    """Return the result without names that do too little to matter on these flights."""
    by_effect: dict[str, list[NamedEffect]] = {}
    for name in result.names:
        by_effect.setdefault(name.candidate.name, []).append(name)
    sizes = {effect: result.size(names) for effect, names in by_effect.items()}
    small = [effect for effect, (_, most) in sizes.items() if not most.relevant(limits)]
    if not small:
        return result
    kept = tuple(name for name in result.names if name.candidate.name not in small)
    search = result.search.refitted(kept)
    return replace(
        result,
        search=search,
        gap=judge(search, result.held, result.gap.floor),
        names=kept,
        negligible=tuple(Negligible(effect, sizes[effect][0]) for effect in small),
    )


def _one_cause(results: tuple[ViewResult, ...]) -> tuple[tuple[ViewResult, ...], list[str]]:
    """Return the results with one cause where one view's name could stand for another's.

    Of a candidate that two views name the one that knows its size better stands.
    """
    kept, told = list(results), list[str]()
    for i, one in enumerate(kept):
        for j, other in enumerate(kept):
            if i == j:
                continue
            names = {name.candidate.name for name in other.names}
            stays = []
            for name in kept[i].names:
                same = [n for n in other.names if n.candidate == name.candidate]
                if same and _relative(other, name) < _relative(one, name):
                    told.append(f"{name.candidate.label}: named by {one.view.name} as well")
                elif not same and set(name.rivals) & names:
                    cause = ", ".join(sorted(set(name.rivals) & names))
                    told.append(
                        f"{one.view.name}: {name.candidate.label} cannot be told from {cause}, "
                        f"which {other.view.name} names"
                    )
                else:
                    stays.append(name)
            kept[i] = replace(kept[i], names=tuple(stays))
    return tuple(kept), told


def _relative(result: ViewResult, name: NamedEffect) -> float:
    """Return the width of a name's numbers over their size."""
    at = list(name.candidate.indices)
    away = np.abs(result.search.estimate.theta[at] - result.search.start.theta[at])
    return float(np.mean([result.half_width[i] for i in at]) / max(away.mean(), 1e-12))


def _verdict(
    results: Sequence[ViewResult], swing: Swing | None, lag: RotorLag | None, limits: Thresholds
) -> str:
    """Return what is said of the gap: what is named is judged by the views that name something.

    Nothing that is fitted swings. A lag of the rotors is in no view.
    """
    named = [one for one in results if one.names]
    if swing:
        return "partly" if named or lag else "unknown"
    if named:
        left = [one.left(one.gap.left, limits) for one in named]
        return "named" if max(left) <= limits.view_left_share else "partly"
    could = [one.left(one.gap.explainable, limits) for one in results]
    if max(could) > limits.view_left_share:
        return "partly" if lag else "unknown"
    return "named" if lag else "no_gap"


def _with_names(
    vehicle: Vehicle,
    space: ParameterSpace,
    results: Sequence[ViewResult],
    lag: RotorLag | None,
) -> Vehicle:
    """Return `vehicle` with what was named, the lag too, in place of what it has of it."""
    theta = space.array("start")
    names = []
    for one in results:
        for name in one.names:
            at = list(name.candidate.indices)
            theta[at] = one.search.estimate.theta[at]
            names.append(name.candidate.name)
    besides = {LAG: EFFECTS[LAG].values(lag.time_constant)} if lag else None
    return with_fitted(vehicle, space, theta, names, besides)

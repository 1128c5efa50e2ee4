"""From flights and a vehicle to a diagnosis."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from eval.effects.log_faults import lateness
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.hold_out import split
from suite.diagnose.data.input_source import another_controller, choose_drive
from suite.diagnose.data.windows import Windows, cut, take
from suite.diagnose.fit.intervals import errors_of
from suite.diagnose.fit.model import Linear, Model
from suite.diagnose.fit.normal_equations import Frame, State, fit, information
from suite.diagnose.fit.parameters import candidates, indices_of, make_space
from suite.diagnose.fit.permutation import FEW, folds_of
from suite.diagnose.fit.search import Finding, search, start_state
from suite.diagnose.fit.turbulence import Turbulence, find_turbulence
from suite.diagnose.verdict.gap import OVERLAP_S, Gap, measure, worse
from suite.diagnose.verdict.residual_structure import Rest, push_of, rest_of
from suite.diagnose.verdict.verdict import COLOURED, SHAPED, Judgement, judge

HALF_STEP = 0.6
"""Share of a physics step up to which pose and rates may be apart by integration alone."""
LOST_M = 50.0
"""A simulated stretch that ends this far from the flight says nothing [m]."""
LEAST = 2
"""Stretches to fit without which nothing can be left out."""


@dataclass(frozen=True)
class Diagnosis:
    """What was found, before it is written down."""

    verdict: str
    finding: Finding
    vehicle: Vehicle
    """With the named effects."""
    widths: np.ndarray
    """Half-widths of the 95 % intervals, in the order of `finding.indices`."""
    before: Gap
    after: Gap
    without: dict[str, Gap]
    """By a named effect's label: the gap with all others."""
    control: tuple[str, Gap] | None
    """A wrong effect fitted in the same way, and its gap."""
    held_out: list[str]
    share_left: float
    """Structured rest over the structured gap before."""
    where: str | None
    rest: Rest
    """Structure in what is left over."""
    turbulence: Turbulence | None
    driven_by: str
    seconds: float
    warnings: list[str]
    model: Model
    held: Windows


def diagnose(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    drive: str = "auto",
    say: Callable[[str], None] = lambda _: None,
    seed: int = 0,
) -> Diagnosis:
    """Find what explains how `logs` differ from `vehicle`.

    Args:
        logs: flights; a fifth of them, at least one, is held out (of a lone flight, the last
            30 %).
        vehicle: the one that the simulation used.
        drive: what drives the model: "commands", "motors", or "auto".
        say: told of the search's steps.
        seed: of the null's draws.

    Raises:
        ValueError: where no flight can be used, or not in the way that was asked for.
    """
    began = time.monotonic()
    by_rotors, warnings = choose_drive(logs, drive), list[str]()
    if drive == "auto" and not by_rotors and another_controller(logs, vehicle):
        warnings.append("the nominal rate loop does not give the measured rotor speeds; they drive")
        by_rotors = True
    space = make_space(vehicle)
    voltage = all(log.voltage is not None for log in logs)
    model = Model(vehicle, space, by_rotors, voltage)
    cut_, notes = cut(logs, vehicle, by_rotors)
    if cut_ is None:
        raise ValueError("no flight has a stretch of 1.3 s without holes; log more, or faster")
    warnings += notes
    begin = start_state(model, cut_)
    linear = model.linearise(begin.theta, begin.offset, cut_, None)
    good = _sound(linear)
    if not good.all():
        broken = int((~good).sum())
        warnings.append(f"{broken} stretches left out: the model's flight from there diverges")
    cut_, linear = take(cut_, good), Linear(*(part[good] for part in linear))
    inside, names = split(logs, cut_, information(linear, cut_, model.size))
    if inside.sum() < LEAST:
        raise ValueError(
            f"{int(inside.sum())} stretches of 1 s to fit, at least {LEAST} are needed: fly longer"
        )
    if inside.sum() < FEW:
        warnings.append(
            f"{int(inside.sum())} stretches of 1 s to fit: too few for a null of their own, so "
            "the null is drawn from the measured noise"
        )
    windows, apart = take(cut_, inside), take(cut_, ~inside)
    has = {"acc_b"} if any(log.acc_b is not None for log in logs) else set()
    among = candidates(space, voltage, has if by_rotors else has | {"command"})
    say(f"{len(windows.flight)} stretches of 1 s to fit, {len(apart.flight)} held out")
    known = Linear(*(part[inside] for part in linear))
    finding = search(model, windows, among, say, known, seed)

    windows = finding.windows
    held = _held_out(logs, vehicle, by_rotors, apart)
    start = start_state(model, windows).theta
    before = measure(model, start, held, finding.sigma)
    after = measure(model, finding.state.theta, held, finding.sigma) if finding.named else before
    if finding.named and worse(before, after):
        warnings.append("what was found on the fitted flights does not hold on held-out ones")
        finding, after = _without_names(model, finding), before
    rest, turbulence = _left_over(model, finding, seed)
    if turbulence and finding.named and not worse(after, before):
        # Wind that lasts from one stretch to the next looks like many a steady number.
        finding, after = _without_names(model, finding), before
        rest, turbulence = _left_over(model, finding, seed)
    judgement = judge(finding, rest, by_rotors)
    if turbulence:
        judgement = Judgement("named", 0.0, None)
    if judgement.verdict == "unknown" and finding.named:
        labels = ", ".join(n.candidate.label for n in finding.named)
        warnings.append(f"nearest in the catalogue, but it leaves most of the gap: {labels}")
        finding, after = _without_names(model, finding), before
    warnings += _of_another_integrator(model, finding)
    without: dict[str, Gap] = {}
    for one in finding.named:
        others = [n.candidate for n in finding.named if n is not one]
        theta = start
        if others:
            theta = finding.state.theta.copy()
            theta[list(one.candidate.indices)] = start[list(one.candidate.indices)]
            state = State(theta, finding.state.offset)
            theta = fit(model, windows, finding.frame, state, indices_of(others))[0].theta
        without[one.candidate.label] = measure(model, theta, held, finding.sigma)
    control = _control(model, windows, finding, held) if finding.named else None
    return Diagnosis(
        verdict=judgement.verdict,
        finding=finding,
        vehicle=_with_effects(vehicle, model, finding, turbulence),
        widths=errors_of(finding.sums),
        before=before,
        after=after,
        without=without,
        control=control,
        held_out=names,
        share_left=judgement.share_left,
        where=judgement.where,
        rest=rest,
        turbulence=turbulence,
        driven_by="measured rotor speeds" if by_rotors else "commands",
        seconds=time.monotonic() - began,
        warnings=warnings,
        model=model,
        held=held,
    )


def _left_over(model: Model, finding: Finding, seed: int) -> tuple[Rest, Turbulence | None]:
    """Return the structure in what `finding` leaves over, and the wind that may have made it."""
    windows = finding.windows
    push = push_of(model, windows, finding.frame, finding.state)
    rest = rest_of(push, folds_of(windows.flight, windows.start_s), seed)
    if not any(p <= COLOURED for axis, p in rest.coloured.items() if axis.startswith("force")):
        return rest, None
    turbulence = find_turbulence(model, finding.state.theta, push)
    # Wind is one explanation and a shape over the state another: the better one counts.
    shape = rest.shapes[0]
    if turbulence and shape.p_value <= SHAPED and shape.gain > turbulence.ratio:
        return rest, None
    return rest, turbulence


def _without_names(model: Model, finding: Finding) -> Finding:
    """Return `finding` with nothing named, at the numbers of the vehicle file."""
    return replace(
        finding, named=[], indices=[], state=start_state(model, finding.windows), explained=0.0
    )


def _of_another_integrator(model: Model, finding: Finding) -> list[str]:
    """Return a warning where a clock's offset may be a simulator's way to integrate."""
    values = model.space.effects(finding.state.theta)
    named = dict.fromkeys(one.candidate.name for one in finding.named)
    late = {name: float(lateness({name: values[name]})) for name in named if EFFECTS[name].late}
    return [
        f"{name}: {1e3 * offset:.2g} ms is about half a physics step; flights of a simulator "
        "that integrates in another way look like this"
        for name, offset in late.items()
        if abs(offset) <= HALF_STEP * model.dt
    ]


def _sound(linear: Linear) -> np.ndarray:
    """Return which windows (W,) the model flies to their end.

    Raises:
        ValueError: where it is none.
    """
    residual = linear.residual
    good = np.asarray(np.isfinite(residual).all(axis=(1, 2)))
    good &= np.isfinite(linear.slope).all(axis=(1, 2, 3))
    good &= (np.abs(residual[..., :3]) < LOST_M).all(axis=(1, 2))
    if not good.any():
        raise ValueError(
            "the model diverges on every flight: check the vehicle file and the frames"
        )
    return good


def _held_out(
    logs: Sequence[FlightLog], vehicle: Vehicle, by_rotors: bool, rest: Windows
) -> Windows:
    """Return overlapping windows over what is held out."""
    if not len(rest.flight):
        raise ValueError("nothing is left to hold out: fly longer, or log a second flight")
    many, _ = cut(logs, vehicle, by_rotors, OVERLAP_S)
    assert many is not None
    inside = np.isin(many.flight, rest.flight) & (many.start_s >= rest.start_s.min() - 1e-6)
    return take(many, inside)


def _control(
    model: Model, windows: Windows, finding: Finding, held: Windows
) -> tuple[str, Gap] | None:
    """Return the best effect that is neither named nor a rival, fitted alone, and its gap."""
    taken = {n.candidate.name for n in finding.named}
    taken |= {rival for n in finding.named for rival in n.rivals}
    wrong = next((s.candidate for s in finding.first if s.candidate.name not in taken), None)
    if wrong is None:
        return None
    frame: Frame = finding.frame
    state = start_state(model, windows)
    theta = fit(model, windows, frame, state, list(wrong.indices))[0].theta
    return wrong.label, measure(model, theta, held, finding.sigma)


def _with_effects(
    vehicle: Vehicle, model: Model, finding: Finding, turbulence: Turbulence | None
) -> Vehicle:
    """Return `vehicle` with the named effects in place of what it has of them."""
    fitted: dict[str, Any] = model.space.effects(finding.state.theta)
    effects = dict(vehicle.effects)
    for name in {n.candidate.name for n in finding.named}:
        values = []
        for value in fitted[name]:
            plain = np.asarray(value, dtype=float)
            values.append(tuple(plain.tolist()) if plain.ndim else float(plain))
        effects[name] = type(fitted[name])(*values)
    if turbulence:
        effects[turbulence.effect] = turbulence.values
    ordered = {name: effects[name] for name in EFFECTS if name in effects}
    return replace(vehicle, effects=MappingProxyType(ordered))

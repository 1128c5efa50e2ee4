"""From flights and a vehicle to a diagnosis."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from eval.effects import EFFECTS
from eval.effects.log_faults import lateness
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.flights import choose_held_out, ready
from suite.diagnose.data.view import FORCE
from suite.diagnose.data.whitening import Linearisation
from suite.diagnose.data.windows import LENGTH_S, FlightWindows, cut, take
from suite.diagnose.estimate.composites import composites
from suite.diagnose.estimate.parameters import candidates, make_space, with_fitted
from suite.diagnose.estimate.permutation import folds_of
from suite.diagnose.evidence.moments import ForceModel
from suite.diagnose.evidence.rollouts import (
    RolloutModel,
    information,
    least_left,
    start_estimate,
    weighed_by,
)
from suite.diagnose.evidence.views import ViewEvidence
from suite.diagnose.search.look import SearchResult, rollouts_of
from suite.diagnose.search.search import search
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.actuators import another_controller, integrator_of, rotors_are_input
from suite.diagnose.verdict.diagnosis import Diagnosis, confirmed, control
from suite.diagnose.verdict.disturbances import Swing, Turbulence, find_turbulence, swing_left
from suite.diagnose.verdict.gap import (
    Gap,
    Verdict,
    measure,
    share_left,
    verdict_on,
    with_model_error,
    with_swing,
    worse,
)
from suite.diagnose.verdict.relevance import gap_matters, relevant_part
from suite.diagnose.verdict.residual_structure import (
    ResidualStructure,
    disturbance_equations,
    residual_structure,
)

BASE_S, STRETCH_S = 5.0, 0.25
"""About how long a diagnosis takes, in all and a stretch more, on two cores [s]."""


class BeyondRollouts(Exception):
    """Rollouts of a second leave far more than noise, whatever of the catalogue is fitted."""


def diagnose(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    drive: str = "auto",
    say: Callable[[str], None] = lambda _: None,
    seed: int = 0,
    limits: Thresholds = THRESHOLDS,
    integrator: str = "auto",
    or_else: bool = False,
) -> Diagnosis:
    """Find what explains how `logs` differ from `vehicle`.

    Args:
        logs: flights; a fifth of them, at least one, is held out (of a lone flight, the last
            30 %).
        vehicle: the one that the simulation used.
        drive: what the model's input is: "commands", "motors", or "auto".
        say: told of the search's steps.
        seed: of the null's draws.
        limits: of every step.
        integrator: how the flights' bodies were moved: "continuous", as every real one, "euler",
            as MuJoCo's steps of the rate loop's period do it, or "auto": what the logs say.
        or_else: end with `BeyondRollouts` where nothing in the catalogue could bring rollouts near.

    Raises:
        BeyondRollouts: see `or_else`.
        ValueError: where no flight can be used, or not in the way that was asked for.
    """
    began = time.monotonic()
    moved = integrator_of(logs, integrator)
    found = _diagnose(logs, vehicle, drive, say, seed, limits, moved, or_else)
    if integrator == "auto" and moved == "continuous" and _looks_stepped(found, limits):
        say("pose and rates are apart by half a step: once more, as MuJoCo's Euler steps")
        stepped = _diagnose(logs, vehicle, drive, say, seed, limits, "euler")
        if not _late(stepped):
            told = "flown as if by MuJoCo's Euler steps, which explain half a step between pose "
            told += "and rates; --integrator continuous does without"
            found = replace(stepped, warnings=[*stepped.warnings, told])
    return replace(found, seconds=time.monotonic() - began)


def _diagnose(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    drive: str,
    say: Callable[[str], None],
    seed: int,
    limits: Thresholds,
    integrator: str,
    or_else: bool = False,
) -> Diagnosis:
    """Return the diagnosis with bodies that `integrator` moves."""
    rotor_input, warnings = rotors_are_input(logs, drive, vehicle), list[str]()
    if drive == "auto" and not rotor_input and another_controller(logs, vehicle, limits):
        without = [log.name for log in logs if log.rotor_speed is None]
        if without:
            raise ValueError(
                "the nominal rate loop does not give the rotor speeds that some flights have, and "
                f"{', '.join(without)} has none to drive by: diagnose the others alone, or with "
                "--drive commands all by what was commanded"
            )
        warnings.append("the nominal rate loop does not give the measured rotor speeds; they drive")
        rotor_input = True
    space = make_space(vehicle)
    voltage = all(log.voltage is not None for log in logs)
    model = RolloutModel(vehicle, space, rotor_input, voltage, integrator)
    whole, notes = cut(logs, vehicle, rotor_input, limits=limits, integrator=integrator)
    if whole is None:
        raise ValueError("no flight has a stretch of 1.3 s without holes; log more, or faster")
    warnings += notes
    _enough(len(whole.flight), limits)  # before anything is compiled
    count = len(whole.flight)
    say(
        f"{count} stretches of 1 s of {len(np.unique(whole.flight))} flights: about "
        f"{BASE_S + count * STRETCH_S:.0f} s, and half a minute more the first time on a machine"
    )
    begin = start_estimate(model, whole)
    linear = model.linearise(begin.theta, begin.free, whole, None)
    good = _sound(linear, limits)
    if not good.all():
        broken = int((~good).sum())
        warnings.append(f"{broken} stretches left out: the model's flight from there diverges")
    rough = _coarser(logs, vehicle, model, rotor_input, whole, limits)
    whole, linear = take(whole, good), _take(linear, good)
    if rough is not None:
        rough = take(rough, good)
        limits = with_model_error(model, begin, whole, linear, rough, limits)
    most = limits.hopeless_chi2
    if or_else and least_left(model, whole, linear, limits, most) > most:
        raise BeyondRollouts
    told = information(linear, whole, model.size, limits)
    inside, names = choose_held_out(logs, whole.flight, whole.start_s, told, limits)
    count = int(inside.sum())
    _enough(count, limits)
    if count < limits.few_windows:
        warnings.append(
            f"{count} stretches of 1 s to fit: too few for a null of their own, so "
            "the null is drawn from the measured noise"
        )
    windows, apart = take(whole, inside), take(whole, ~inside)
    has = {"acc_b"} if any(log.acc_b is not None for log in logs) else set()
    among = candidates(space, voltage, has if rotor_input else has | {"command"})
    among += composites(among)
    say(f"{len(windows.flight)} stretches of 1 s to fit, {len(apart.flight)} held out")
    start = start_estimate(model, windows)
    known = weighed_by(model, windows, _take(linear, inside), limits)
    found = search(known[0], start, among, say, seed, known)
    noise = rollouts_of(found.last).noise

    held = _held_out(logs, vehicle, rotor_input, apart, limits, integrator)
    before = measure(model, begin.theta, held, noise, limits)
    after = before
    if found.named:
        after = measure(model, found.estimate.theta, held, noise, limits)
        if worse(before, after, limits=limits):
            warnings.append("what was found on the fitted flights does not hold on held-out ones")
            found, after = found.refitted(()), before
    found, after, without, gone = confirmed(model, found, held, (before, after), limits)
    warnings += [f"{label}: withdrawn, held-out flights are no better for it" for label in gone]
    rough = take(rough, inside) if rough is not None and rotor_input else None
    explained = found, (before, after)
    found, after, sizes, small = relevant_part(model, found, held, (before, after), limits, rough)
    warnings += [f"{one.name}: left out, too small to matter: {one.size.words()}" for one in small]

    def leaves(
        found: SearchResult, gaps: tuple[Gap, Gap]
    ) -> tuple[ResidualStructure, Turbulence | None, Verdict]:
        """Return the structure in what is left over, its wind, and the verdict on it."""
        residual, turbulence = _left_over(model, found, seed, limits)
        if not gap_matters(gaps[1], len(held.flight), limits):
            label = "named" if found.named else "no_gap"
            return residual, None, Verdict(label, share_left(*gaps) if found.named else 0.0)
        slow = rollouts_of(found.last).slow_errors(found.last.block)
        verdict = verdict_on(bool(found.named), slow, residual, gaps, rotor_input, limits)
        return residual, turbulence, verdict

    # What is too small to matter explains what it explains.
    (residual, turbulence, verdict), swing = leaves(*explained), None
    if small and not found.named and verdict.label in ("named", "partly"):
        verdict = verdict._replace(label="no_gap" if verdict.label == "named" else "unknown")
    if turbulence or verdict.where:
        swing = _swing(logs, vehicle, voltage, found, limits)
    if swing:
        verdict, turbulence = with_swing(verdict, swing.words, bool(found.named)), None
    if turbulence and found.named and not worse(after, before, limits=limits):
        # Wind that lasts from one stretch to the next looks like many a steady number.
        found, after = found.refitted(()), before
        residual, turbulence, verdict = leaves(found, (before, after))
    if turbulence:
        verdict = Verdict("named", share_left(before, after))
    if verdict.label == "unknown" and found.named:
        labels = ", ".join(candidate.label for candidate in found.candidates)
        warnings.append(f"nearest in the catalogue, but it leaves most of the gap: {labels}")
        found, after = found.refitted(()), before
        residual, _, bare = leaves(found, (before, after))
        verdict = Verdict("unknown", 1.0, bare.where or verdict.where)
        swing = _swing(logs, vehicle, voltage, found, limits) if swing else None
        if swing:
            verdict = with_swing(verdict, swing.words, False)
    return Diagnosis(
        verdict=verdict,
        search=found,
        half_width=dict(zip(found.indices, map(float, found.half_widths()), strict=True)),
        vehicle=_with_effects(vehicle, model, found, turbulence),
        before=before,
        after=after,
        without={candidate.label: without[candidate.label] for candidate in found.candidates},
        control=control(model, found, held, limits) if found.named else None,
        residual=residual,
        turbulence=turbulence,
        logs=logs,
        nominal=vehicle,
        rotor_input=rotor_input,
        sizes=sizes,
        negligible=small,
        held_out=names,
        held_windows=held,
        model=model,
        seconds=0.0,
        warnings=warnings,
        seed=seed,
        limits=limits,
    )


def _coarser(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    model: RolloutModel,
    rotor_input: bool,
    whole: FlightWindows,
    limits: Thresholds,
) -> FlightWindows | None:
    """Return the windows `whole` with steps of twice the length and half of the rotor speeds.

    None where that changes nothing: a simulator's own steps, driven by commands.
    """
    if model.integrator == "euler" and not rotor_input:
        return None
    how = (rotor_input, LENGTH_S, limits, model.integrator, whole)
    return cut(logs, vehicle, *how)[0]


def _enough(count: int, limits: Thresholds) -> None:
    """Refuse fewer stretches than can be fitted.

    Raises:
        ValueError: saying how many there are and have to be.
    """
    if count < limits.least_windows:
        raise ValueError(
            f"{count} stretches of 1 s to fit, at least {limits.least_windows} are needed: fly "
            "longer"
        )


def _take(linear: Linearisation, chosen: np.ndarray) -> Linearisation:
    return Linearisation(*(part[chosen] for part in linear))


def _left_over(
    model: RolloutModel, found: SearchResult, seed: int, limits: Thresholds
) -> tuple[ResidualStructure, Turbulence | None]:
    """Return the structure in what `found` leaves over, and the wind that may have made it."""
    evidence = rollouts_of(found.last)
    windows, whitening = evidence.trusted, evidence.whitening
    equations = disturbance_equations(model, windows, whitening, found.estimate, limits)
    fold = folds_of(windows.flight, windows.start_s, limits.folds)
    residual = residual_structure(equations, fold, seed, limits)
    forces = [p for axis, p in residual.coloured.items() if axis.startswith("force")]
    if not any(p <= limits.colour_p_value for p in forces):
        return residual, None
    turbulence = find_turbulence(model, found.estimate.theta, equations, limits)
    # Wind is one explanation and a shape over the state another: the better one counts.
    shape = residual.shapes[0]
    if turbulence and shape.p_value <= limits.shape_p_value and shape.gain > turbulence.ratio:
        return residual, None
    return residual, turbulence


def _swing(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    voltage: bool,
    found: SearchResult,
    limits: Thresholds,
) -> Swing | None:
    """Return the swing in what translation under the measured attitude leaves of `found`."""
    try:
        flights = ready(logs, vehicle, limits).smoothed[FORCE.name]
    except ValueError:  # rollouts need other stretches than this look, which is one more
        return None
    model = ForceModel(vehicle, make_space(vehicle), voltage)
    return swing_left(ViewEvidence(FORCE, model, flights, limits), found.estimate.theta)


def _late(found: Diagnosis) -> dict[str, float]:
    """Return by name how much later than they were poses are logged [s], of what was named."""
    values = found.model.space.effects(found.search.estimate.theta)
    named = dict.fromkeys(candidate.name for candidate in found.search.candidates)
    return {name: float(lateness({name: values[name]})) for name in named if EFFECTS[name].late}


def _looks_stepped(found: Diagnosis, limits: Thresholds) -> bool:
    """Say whether pose and rates are apart by what MuJoCo's Euler steps make of them."""
    step = 1.0 / found.nominal.controller.frequency
    return any(abs(offset) <= limits.integrator_share * step for offset in _late(found).values())


def _sound(linear: Linearisation, limits: Thresholds) -> np.ndarray:
    """Return which windows (W,) the model flies to their end.

    Raises:
        ValueError: where it is none.
    """
    residual = linear.residual
    good = np.asarray(np.isfinite(residual).all(axis=(1, 2)))
    good &= np.isfinite(linear.slope).all(axis=(1, 2, 3))
    good &= (np.abs(residual[..., :3]) < limits.diverged_m).all(axis=(1, 2))
    if not good.any():
        raise ValueError(
            "the model diverges on every flight: check the vehicle file and the frames"
        )
    return good


def _held_out(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    rotor_input: bool,
    apart: FlightWindows,
    limits: Thresholds,
    integrator: str,
) -> FlightWindows:
    """Return overlapping windows over what is held out, of which `apart` do not overlap."""
    if not len(apart.flight):
        raise ValueError("nothing is left to hold out: fly longer, or log a second flight")
    how = (rotor_input, limits.gap_stride_s, limits, integrator)
    many, _ = cut(logs, vehicle, *how, only=np.unique(apart.flight).tolist())
    assert many is not None
    return take(many, many.start_s >= apart.start_s.min() - 1e-6)


def _with_effects(
    vehicle: Vehicle, model: RolloutModel, found: SearchResult, turbulence: Turbulence | None
) -> Vehicle:
    """Return `vehicle` with the named effects in place of what it has of them."""
    names = [candidate.name for candidate in found.candidates]
    wind = {turbulence.effect: turbulence.values} if turbulence else {}
    return with_fitted(vehicle, model.space, found.estimate.theta, names, wind)

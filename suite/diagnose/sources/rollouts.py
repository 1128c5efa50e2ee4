"""Makes the source `whole` from flights: stretches of 1 s, of which some are held out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.flights import choose_held_out
from suite.diagnose.data.sampling import own_spacing_s, rows_show_torque
from suite.diagnose.data.whitening import Linearisation
from suite.diagnose.data.windows import LENGTH_S, FlightWindows, cut, remembers, take
from suite.diagnose.estimate.composites import composites
from suite.diagnose.estimate.parameters import candidates, make_space
from suite.diagnose.evidence.rollouts import (
    RolloutModel,
    information,
    least_left,
    start_estimate,
    weighed_by,
)
from suite.diagnose.sources.rollout_source import RolloutSource
from suite.diagnose.sources.source import Given, Source, Sources
from suite.diagnose.thresholds import Thresholds
from suite.diagnose.verdict.actuators import another_controller, integrator_of, rotors_are_input
from suite.diagnose.verdict.rollout_gap import MEASURE, Rollouts, with_model_error

BASE_S, STRETCH_S = 5.0, 0.25
"""Estimated duration on two cores: fixed part, and for each stretch [s]."""


def by_rollouts(given: Given, before: Sequence[Source]) -> Sources | None:
    """Return the source of rollouts; None where the logs lack a signal that a rollout needs.

    None also where no effect of the catalogue brings rollouts of 1 s near the flights, unless this
    source was chosen by name.

    Raises:
        ValueError: where no flight can be used, or not in the way that was chosen.
    """
    logs, vehicle = given.logs, given.vehicle
    if before or given.references or not (given.chosen or can_fly(logs, vehicle)):
        return None
    integrator = integrator_of(logs, given.integrator)
    rotor_input, warnings = rotors_are_input(logs, given.drive, vehicle), list[str]()
    if given.drive == "auto" and not rotor_input:
        rotor_input = _flown_by_another(logs, vehicle, given.limits)
        if rotor_input:
            warnings.append(
                "the nominal rate loop does not give the measured rotor speeds; they drive"
            )
    space, limits = make_space(vehicle), given.limits
    voltage = all(log.voltage is not None for log in logs)
    model = RolloutModel(vehicle, space, rotor_input, voltage, integrator)
    whole, notes = cut(logs, vehicle, rotor_input, limits=limits, integrator=integrator)
    if whole is None:
        raise ValueError("no flight has a stretch of 1.3 s without holes; log more, or faster")
    warnings += notes
    _enough(len(whole.flight), limits)  # before anything is compiled
    count = len(whole.flight)
    given.say(
        f"{count} stretches of 1 s of {len(np.unique(whole.flight))} flights: about "
        f"{BASE_S + count * STRETCH_S:.0f} s, and half a minute more the first time on a machine"
    )
    begin = start_estimate(model, whole)
    linear = model.linearise(begin.theta, begin.free, whole, None)
    good = _sound(linear, limits)
    if not good.all():
        broken = int((~good).sum())
        warnings.append(f"{broken} stretches left out: the model's flight from there diverges")
    rough = None
    if integrator != "euler" or rotor_input:  # a simulator's own steps are exact
        rough = cut(logs, vehicle, rotor_input, LENGTH_S, limits, integrator, whole)[0]
    whole, linear = take(whole, good), _take(linear, good)
    if rough is not None:
        rough = take(rough, good)
        limits = with_model_error(model, begin, whole, linear, rough, limits)
    most = limits.hopeless_chi2
    if not given.chosen and least_left(model, whole, linear, limits, most) > most:
        given.say("no effect brings rollouts of 1 s near these flights: using force and torque")
        return None
    informed = information(linear, whole, model.size, limits)
    inside, names = choose_held_out(logs, whole.flight, whole.start_s, informed, limits)
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
    given.say(f"{len(windows.flight)} stretches of 1 s to fit, {len(apart.flight)} held out")
    held = _held_out(given, rotor_input, apart, limits, integrator)
    lone = bool(np.isin(held.flight, windows.flight).any())
    since_s = float(np.min(held.start_s)) if lone else 0.0
    dense = all(
        log.rotor_speed is None
        or rows_show_torque(vehicle, own_spacing_s(log.time_s, log.rotor_speed))
        for log in logs
    )
    flown = Rollouts(model, logs, vehicle, rotor_input, held, since_s, limits)
    source = RolloutSource(
        name="whole",
        about="whole flights, in rollouts of a second",
        subject="error of rollouts of a second",
        unit="times the noise",
        measure=MEASURE,
        horizon_s=LENGTH_S,
        known=weighed_by(model, windows, _take(linear, inside), limits),
        start=start_estimate(model, windows),
        among=[*among, *composites(among)],
        limits=limits,
        small_explains=True,
        rollouts=flown,
        flown=flown,
        coarser=take(rough, inside) if rough is not None and rotor_input else None,
        coarser_share=0.5 if dense else 2.0,
    )
    driven_by = "measured rotor speeds" if rotor_input else "commands"
    return Sources((source,), names, driven_by, tuple(warnings))


def can_fly(logs: Sequence[FlightLog], vehicle: Vehicle) -> bool:
    """Return whether rollouts can be simulated.

    The logs must be complete, with measured rotor speeds, or with commands to a rate loop without
    integrators and filters.
    """
    return not any(
        log.partial or (log.rotor_speed is None and (log.rate_cmd_b is None or remembers(vehicle)))
        for log in logs
    )


def _flown_by_another(logs: Sequence[FlightLog], vehicle: Vehicle, limits: Thresholds) -> bool:
    """Return whether another controller flew, so that measured rotor speeds have to drive.

    Raises:
        ValueError: where one did, and some flights have no rotor speeds.
    """
    if not another_controller(logs, vehicle, limits):
        return False
    without = [log.name for log in logs if log.rotor_speed is None]
    if without:
        raise ValueError(
            "the nominal rate loop does not give the rotor speeds that some flights have, and "
            f"{', '.join(without)} has none to drive by: diagnose the others alone, or with "
            "--drive commands all by what was commanded"
        )
    return True


def _enough(count: int, limits: Thresholds) -> None:
    """Refuse fewer stretches than can be fitted.

    Raises:
        ValueError: with the number of stretches and the least one.
    """
    if count < limits.least_windows:
        raise ValueError(
            f"{count} stretches of 1 s to fit, at least {limits.least_windows} are needed: fly "
            "longer"
        )


def _take(linear: Linearisation, chosen: np.ndarray) -> Linearisation:
    return Linearisation(*(part[chosen] for part in linear))


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
    given: Given, rotor_input: bool, apart: FlightWindows, limits: Thresholds, integrator: str
) -> FlightWindows:
    """Return overlapping windows over what is held out, of which `apart` do not overlap."""
    if not len(apart.flight):
        raise ValueError("nothing is left to hold out: fly longer, or log a second flight")
    how = (rotor_input, limits.gap_stride_s, limits, integrator)
    many, _ = cut(given.logs, given.vehicle, *how, only=np.unique(apart.flight).tolist())
    assert many is not None
    return take(many, many.start_s >= apart.start_s.min() - 1e-6)

"""Makes the source of evidence `whole`, which compares simulated stretches of 1 s with flights.

Such a stretch (a window; W is their number) is a rollout: it starts from a measured state, and
commands or rotor speeds drive it. Some stretches are fitted, the others held out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.hold_out import choose_held_out
from suite.diagnose.data.noise import Linearisation, measured_noise
from suite.diagnose.data.sampling import own_spacing_s
from suite.diagnose.data.steps import has_firmware_loop, rows_show_torque
from suite.diagnose.data.whitening import block_of, make_whitening
from suite.diagnose.data.windows import LENGTH_S, FlightWindows, cut, take
from suite.diagnose.estimate.block import Estimate
from suite.diagnose.estimate.composites import composites
from suite.diagnose.estimate.parameters import candidates
from suite.diagnose.evidence.evidence import Evaluation
from suite.diagnose.evidence.rollouts import (
    RolloutModel,
    is_hopeless,
    rollout_evidence,
    start_estimate,
)
from suite.diagnose.sources.input_error import (
    push_slopes,
    share_between,
    unknown_commands,
    with_input_error,
    with_model_error,
)
from suite.diagnose.sources.rollout_source import RolloutSource
from suite.diagnose.sources.source import FAR, DiagnosisInput, SourceSet
from suite.diagnose.thresholds import Thresholds
from suite.diagnose.verdict.actuators import (
    flown_by_other_controller,
    integrator_of,
    rotors_are_input,
)

BASE_S, STRETCH_S = 5.0, 0.25
"""Estimated duration on two cores: fixed part, and for each stretch [s]."""
MEASURE = (
    "RMS of slow errors of 1 s rollouts on held-out data, start free within its noise, over "
    "position, attitude, velocity and rates, in units of what measurement noise gives"
)

LACKING = (
    "the drone received commands between the rows of the log; the mean of their neighbours stands "
    "for them, and what it may change counts as noise: log every command, to find smaller effects"
)


def by_rollouts(given: DiagnosisInput) -> SourceSet | None:
    """Make the source of rollouts; None if the logs lack a signal that a rollout needs.

    Unless it was chosen by name, the set is empty if even all effects of the catalogue leave the
    rollouts far from the flights.

    Raises:
        ValueError: if no flight can be used, or none with the chosen drive (model input).
    """
    logs, vehicle, limits = given.logs, given.vehicle, given.limits
    if given.chosen and given.references:
        raise ValueError("rollouts cannot find a change since reference flights; views can")
    if given.references or not (given.chosen or can_fly(logs, vehicle)):
        return None
    integrator = integrator_of(logs, given.integrator)
    rotor_input, warnings = rotors_are_input(logs, given.drive, vehicle), list[str]()
    is_open = given.drive == "auto" and not rotor_input
    if is_open and flown_by_other_controller(logs, vehicle, limits):
        without = [log.name for log in logs if log.rotor_speed is None]
        if without:
            raise ValueError(
                "the nominal rate loop does not reproduce the rotor speeds that some flights "
                f"have, and {', '.join(without)} has none as an input: diagnose the other flights "
                "without it, or use the commands of all with --drive commands"
            )
        rotor_input = True
        warnings.append(
            "the nominal rate loop does not reproduce the measured rotor speeds, so these are the "
            "model's input"
        )
    # Cut the flights into stretches, and simulate each with the given vehicle.
    windows_of = partial(cut, logs, vehicle, rotor_input, limits=limits, integrator=integrator)
    windows, notes = windows_of()
    if windows is None:
        raise ValueError(f"{'; '.join(notes)}: fly longer, or log faster")
    warnings += notes
    count = len(windows.flight)
    _check_count(count, limits)  # before anything is compiled
    given.say(
        f"{count} stretches of 1 s of {len(np.unique(windows.flight))} flights: about "
        f"{BASE_S + count * STRETCH_S:.0f} s, and half a minute more the first time on a machine"
    )
    voltage = all(log.voltage is not None for log in logs)
    model = RolloutModel(vehicle, rotor_input, voltage, integrator)
    linear, is_finite = _simulated(model, windows, limits)
    if not is_finite.all():
        diverged = int((~is_finite).sum())
        warnings.append(f"{diverged} stretches left out: the model's flight from there diverges")
    # Estimate the model's numerical error from the same stretches with steps of twice the length.
    # Flights that a simulator flew with Euler steps, driven by commands, have no such error.
    has_error = integrator != "euler" or rotor_input
    coarser = take(windows_of(like=windows, stride=2)[0], is_finite) if has_error else None
    if coarser is not None:
        limits = with_model_error(linear, _difference(model, linear, coarser), limits)
    # See `RolloutSource.sizes` for these shares.
    dense = all(
        log.rotor_speed is None
        or rows_show_torque(vehicle, own_spacing_s(log.time_s, log.rotor_speed))
        for log in logs
    )
    coarser_share = 0.0 if coarser is None or not rotor_input else (0.5 if dense else 2.0)
    commands = [(log.time_s, log.rate_cmd_b) for log in logs if log.rate_cmd_b is not None]
    are_slow = any(own_spacing_s(*command) > limits.command_spacing_s for command in commands)
    lacking = False
    push_error = None
    if are_slow and not rotor_input:
        between = take(windows_of(between=True)[0], is_finite)
        low, high = share_between(linear, _difference(model, linear, between), limits)
        lacking = low > limits.lacking_share
        if high > limits.held_share:  # unclear, so effects must be larger than what it changes
            coarser, coarser_share = between, 1.0
    if lacking:
        warnings.append(LACKING)
        # Rotor speeds follow the unknown commands, so they are not compared.
        logs = [replace(log, rotor_speed=None) for log in logs]
        held_of = partial(cut, logs, vehicle, False, limits=limits, integrator=integrator)
        windows_of = partial(held_of, between=True)
        linear, is_finite = _simulated(model, windows_of()[0], limits)
        coarser, coarser_share = take(held_of(like=linear.windows)[0], is_finite), 1.0
        push = push_slopes(model, linear)
        difference = _difference(model, linear, coarser)
        push_error, limits = unknown_commands(linear, push, difference, limits)
        linear = linear._replace(windows=with_input_error(linear.windows, push, push_error))
        coarser = with_input_error(coarser, push, push_error)
    if not given.chosen and is_hopeless(model, linear, limits):
        given.say("no effect brings rollouts of 1 s near these flights: using force and torque")
        return SourceSet((), (), "", (FAR,))
    # Choose which stretches are held out, by their information on each parameter.
    windows = linear.windows
    whitening = make_whitening(linear, measured_noise(linear, limits), limits)
    informed = (block_of(whitening, linear, range(model.size)).slope ** 2).sum(axis=1)
    is_fitted, names = choose_held_out(logs, windows.flight, windows.start_s, informed, limits)
    count = int(is_fitted.sum())
    _check_count(count, limits)
    if count < limits.few_windows:
        warnings.append(
            f"{count} stretches of 1 s to fit: too few for a permutation test, so the null "
            "distribution is drawn from the measured noise"
        )
    fitted, not_fitted = take(windows, is_fitted), take(windows, ~is_fitted)
    given.say(f"{count} stretches of 1 s to fit, {len(not_fitted.flight)} held out")
    if not len(not_fitted.flight):
        raise ValueError("no stretch can be held out: fly longer, or log a second flight")
    # The gap is more precise with windows that overlap.
    since_s = float(not_fitted.start_s.min())
    held_flights = np.unique(not_fitted.flight).tolist()
    held, _ = windows_of(stride_s=limits.gap_stride_s, only=held_flights, since_s=since_s)
    assert held is not None
    held_linear = model.linearise(start_estimate(model, held), held, [])
    flies = _finite(held_linear, limits)
    if push_error is not None:
        error = np.sqrt((push_error**2).mean(axis=0))
        held = with_input_error(held, push_slopes(model, held_linear), error)
    if not flies.all():
        held = take(held, flies)
        warnings.append(f"{(~flies).sum()} held-out stretches left out: the model diverges there")
    # Effects on a signal that the logs lack, or that the model does not use, are not candidates.
    signals = {"acc_b"} if any(log.acc_b is not None for log in logs) else set()
    single = candidates(model.space, voltage, signals if rotor_input else signals | {"command"})
    evidence, block = rollout_evidence(model, take(linear, is_fitted), limits)
    source = RolloutSource(
        name="whole",
        about="whole flights, in rollouts of a second",
        subject="error of rollouts of a second",
        unit="times the noise",
        measure=MEASURE,
        horizon_s=LENGTH_S,
        begin=Evaluation(evidence, start_estimate(model, fitted), block),
        candidates=[*single, *composites(single)],
        limits=limits,
        small_explains=True,
        model=model,
        logs=logs,
        vehicle=vehicle,
        rotor_input=rotor_input,
        held=held,
        # Of a lone flight the end is held out.
        since_s=since_s if np.isin(not_fitted.flight, fitted.flight).any() else 0.0,
        between=lacking,
        coarser=take(coarser, is_fitted) if coarser_share else None,
        coarser_share=coarser_share,
    )
    driven_by = "measured rotor speeds" if rotor_input else "commands"
    return SourceSet((source,), names, driven_by, tuple(warnings))


def can_fly(logs: Sequence[FlightLog], vehicle: Vehicle) -> bool:
    """Return whether the logs have all signals of the state, and an input of rollouts.

    That is measured rotor speeds, or commands to a rate loop without integrators and filters.
    """
    return not any(
        log.partial
        or (log.rotor_speed is None and (log.rate_cmd_b is None or has_firmware_loop(vehicle)))
        for log in logs
    )


def _check_count(count: int, limits: Thresholds) -> None:
    """Raise a ValueError if `count` stretches are too few to fit."""
    if count < limits.least_windows:
        raise ValueError(
            f"{count} stretches of 1 s to fit, at least {limits.least_windows} are needed: fly "
            "longer"
        )


def _simulated(
    model: RolloutModel, windows: FlightWindows, limits: Thresholds
) -> tuple[Linearisation, np.ndarray]:
    """Return the linearised windows in which the model does not diverge, and which (W,) these are.

    Raises:
        ValueError: if the model diverges in all of them.
    """
    linear = model.linearise(start_estimate(model, windows), windows)
    is_finite = _finite(linear, limits)
    return take(linear, is_finite), is_finite


def _difference(model: RolloutModel, linear: Linearisation, other: FlightWindows) -> np.ndarray:
    """Return the residuals (W, N, 19) of windows with `other` inputs, minus those of `linear`."""
    at = Estimate(model.space.array("start"), linear.offset)
    return model.residual(at, other) - linear.residual


def _finite(linear: Linearisation, limits: Thresholds) -> np.ndarray:
    """Return which windows (W,) the model simulates without divergence; a ValueError if none."""
    residual = linear.residual
    is_finite = np.asarray(np.isfinite(residual).all(axis=(1, 2)))
    is_finite &= np.isfinite(linear.slope).all(axis=(1, 2, 3))
    is_finite &= (np.abs(residual[..., :3]) < limits.diverged_m).all(axis=(1, 2))  # the position
    if not is_finite.any():
        raise ValueError(
            "the model diverges on every flight: check the vehicle file and the frames"
        )
    return is_finite

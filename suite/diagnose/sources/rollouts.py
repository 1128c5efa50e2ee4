"""Makes the source of evidence `whole`, which compares simulated stretches of 1 s with flights.

Such a stretch (a window; W is their number) is a rollout: it starts from a measured state, and
commands or rotor speeds drive it. Some stretches are fitted, the others held out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.hold_out import choose_held_out
from suite.diagnose.data.noise import measured_noise
from suite.diagnose.data.steps import has_firmware_loop
from suite.diagnose.data.whitening import block_of, make_whitening
from suite.diagnose.data.windows import LENGTH_S, take
from suite.diagnose.estimate.composites import composites
from suite.diagnose.estimate.parameters import candidates
from suite.diagnose.evidence.evidence import Evaluation
from suite.diagnose.evidence.rollouts import (
    is_hopeless,
    rollout_evidence,
    start_estimate,
)
from suite.diagnose.sources.rollout_source import RolloutSource
from suite.diagnose.sources.source import FAR, DiagnosisInput, SourceSet
from suite.diagnose.sources.stretches import check_count, simulated_stretches
from suite.diagnose.verdict.actuators import (
    flown_by_other_controller,
    integrator_of,
    rotors_are_input,
)

MEASURE = (
    "RMS of slow errors of 1 s rollouts on held-out data, start free within its noise, over "
    "position, attitude, velocity and rates, in units of what measurement noise gives"
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
    made, notes = simulated_stretches(given, rotor_input, integrator)
    model, linear, limits = made.model, made.linear, made.limits
    warnings += notes
    if not given.chosen and is_hopeless(model, linear, limits):
        given.say("no effect brings rollouts of 1 s near these flights: using force and torque")
        return SourceSet((), (), "", (FAR,))
    # Choose which stretches are held out, by their information on each parameter.
    windows = linear.windows
    whitening = make_whitening(linear, measured_noise(linear, limits), limits)
    informed = (block_of(whitening, linear, range(model.size)).slope ** 2).sum(axis=1)
    is_fitted, names = choose_held_out(logs, windows.flight, windows.start_s, informed, limits)
    count = int(is_fitted.sum())
    check_count(count, limits)
    if count < limits.few_windows:
        warnings.append(
            f"{count} stretches of 1 s to fit: too few for a permutation test, so the null "
            "distribution is drawn from the measured noise"
        )
    fitted, not_fitted = take(windows, is_fitted), take(windows, ~is_fitted)
    given.say(f"{count} stretches of 1 s to fit, {len(not_fitted.flight)} held out")
    # The gap is more precise with windows that overlap.
    since_s = float(not_fitted.start_s.min())
    held_flights = np.unique(not_fitted.flight).tolist()
    held, diverged = made.overlapping(held_flights, since_s)
    if diverged:
        warnings.append(f"{diverged} held-out stretches left out: the model diverges there")
    # Effects on a signal that the logs lack, or that the model does not use, are not candidates.
    signals = {"acc_b"} if any(log.acc_b is not None for log in logs) else set()
    voltage = all(log.voltage is not None for log in logs)
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
        cut=made.cut,
        held=held,
        # Of a lone flight the end is held out.
        since_s=since_s if np.isin(not_fitted.flight, fitted.flight).any() else 0.0,
        coarser=None if made.coarser is None else take(made.coarser, is_fitted),
        coarser_share=made.coarser_share,
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

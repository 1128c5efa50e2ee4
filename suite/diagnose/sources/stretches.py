"""Cuts flights into stretches of 1 s, simulates them, and estimates the error of the simulation.

A stretch (a window; W is their number) is simulated with the nominal vehicle. Unknown inputs and
the time steps cause an error, which is estimated by simulations with other or coarser inputs.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from suite.diagnose.data.noise import Linearisation
from suite.diagnose.data.sampling import own_spacing_s
from suite.diagnose.data.steps import rows_show_torque
from suite.diagnose.data.windows import (
    FlightWindows,
    command_jitter_s,
    cut,
    has_times_of_commands,
    take,
)
from suite.diagnose.evidence.rollouts import RolloutModel, start_estimate
from suite.diagnose.sources.input_error import (
    COMMANDED,
    FINE_KNOTS,
    as_likely,
    push_slopes,
    residual_change,
    share_between,
    unknown_commands,
    with_input_error,
    with_mean_errors,
    with_model_error,
)
from suite.diagnose.sources.source import DiagnosisInput
from suite.diagnose.thresholds import Thresholds

BASE_S, STRETCH_S = 5.0, 0.25
"""Estimated duration on two cores: fixed part, and for each stretch [s]."""
LACKING = (
    "the drone probably received commands between the rows of the log; the mean of their "
    "neighbours stands for them, and what it may change counts as noise: log every command, to "
    "find smaller effects"
)


@dataclass(frozen=True)
class Stretches:
    """Stretches of flights, and their simulation with the nominal vehicle."""

    cut: partial[tuple[FlightWindows | None, list[str]]]
    """`cut` of `data/windows.py` with the flights and the vehicle."""
    model: RolloutModel
    linear: Linearisation
    """Linearisation along all parameters and start numbers, of stretches that do not diverge."""
    limits: Thresholds
    """Thresholds, with the model's own error in the lower limits of the noise."""
    coarser: FlightWindows | None = None
    """The same stretches with coarser inputs, see `RolloutSource.coarser`."""
    coarser_share: float = 0.0
    """See `RolloutSource.coarser_share`."""
    push_error: np.ndarray | None = None
    """(W, 4) error of thrust [m/s^2] and torque [rad/s^2] by commands that the logs lack, or whose
    times are uncertain; None if all are known."""

    def overlapping(self, flights: Collection[int], since_s: float) -> tuple[FlightWindows, int]:
        """Return overlapping windows of `flights` after `since_s` [s], and how many diverge.

        Those that diverge are left out.
        """
        stride_s = self.limits.gap_stride_s
        windows, _ = self.cut(stride_s=stride_s, only=flights, since_s=since_s)
        assert windows is not None  # these flights had some before
        linear = self.model.linearise(start_estimate(self.model, windows), windows, [])
        if self.push_error is not None:
            error = np.sqrt((self.push_error**2).mean(axis=0))
            push = push_slopes(self.model, linear, FINE_KNOTS)[..., COMMANDED]
            windows = with_input_error(windows, push, error)
        if self.cut.keywords.get("between"):
            windows = with_mean_errors(self.model, linear._replace(windows=windows))
        flies = _finite(linear, self.limits)
        return take(windows, flies), int((~flies).sum())


def simulated_stretches(
    given: DiagnosisInput, rotor_input: bool, integrator: str
) -> tuple[Stretches, list[str]]:
    """Cut the flights into stretches and simulate them; return them and warnings.

    Raises:
        ValueError: if there are too few stretches, or the model diverges in all of them.
    """
    logs, vehicle, limits = given.logs, given.vehicle, given.limits
    windows_of = partial(cut, logs, vehicle, rotor_input, limits=limits, integrator=integrator)
    windows, warnings = windows_of()
    if windows is None:
        raise ValueError(f"{'; '.join(warnings)}: fly longer, or log faster")
    count = len(windows.flight)
    check_count(count, limits)  # before anything is compiled
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
    made = Stretches(windows_of, model, linear, limits)
    # Estimate the model's numerical error from the same stretches with steps of twice the length.
    # Flights that a simulator flew with Euler steps, driven by commands, have no such error.
    if integrator != "euler" or rotor_input:
        coarser = take(windows_of(like=windows, stride=2)[0], is_finite)
        limits = with_model_error(linear, residual_change(model, linear, coarser), limits)
        made = replace(made, limits=limits)
        if rotor_input:
            # See `RolloutSource.sizes` for these shares.
            rotors = [(log.time_s, log.rotor_speed) for log in logs if log.rotor_speed is not None]
            dense = all(rows_show_torque(vehicle, own_spacing_s(*rotor)) for rotor in rotors)
            made = replace(made, coarser=coarser, coarser_share=0.5 if dense else 2.0)
    if not rotor_input and any(map(command_jitter_s, logs)):
        jittered = take(windows_of(jitter=True)[0], is_finite)
        made = _with_unknown(made, jittered)
    commands = [
        (log.time_s, log.rate_cmd_b)
        for log in logs
        if log.rate_cmd_b is not None and not has_times_of_commands(log)
    ]
    are_slow = any(own_spacing_s(*command) > limits.command_spacing_s for command in commands)
    if rotor_input or not are_slow:
        return made, warnings
    # The drone may have received commands between the rows.
    between = take(windows_of(between=True)[0], is_finite)
    difference, push = residual_change(model, linear, between), push_slopes(model, linear)
    share = share_between(made.linear, difference, push, made.limits)
    if share.are_lacking(limits):
        return _with_unknown_commands(made), [*warnings, LACKING]
    if not share.are_complete(limits):  # effects must be larger than what it changes
        made = replace(made, coarser=between, coarser_share=1.0)
    return made, warnings


def _with_unknown_commands(made: Stretches) -> Stretches:
    """Return the stretches with the mean of two commands between them, and the error of this.

    Rotor speeds follow the unknown commands, so they are not compared.
    """
    logs, *options = made.cut.args
    logs = [replace(log, rotor_speed=None) for log in logs]
    held_of = partial(cut, logs, *options, **made.cut.keywords)
    windows_of = partial(held_of, between=True)
    windows, _ = windows_of()
    assert windows is not None  # the same flights had some before
    linear, is_finite = _simulated(made.model, windows, made.limits)
    held = take(held_of(like=windows)[0], is_finite)
    made = _with_unknown(replace(made, cut=windows_of, linear=linear), as_likely(linear.windows))
    # Held commands are a limit case of other weights: they are fitted without these errors.
    held = held._replace(input_error=made.linear.windows.input_error)
    linear = made.linear._replace(windows=with_mean_errors(made.model, made.linear))
    return replace(made, linear=linear, coarser=held, coarser_share=2.0)


def _with_unknown(made: Stretches, other: FlightWindows) -> Stretches:
    """Return the stretches with the error of their commands.

    The `other` windows are the same with commands that are as likely.
    """
    difference = residual_change(made.model, made.linear, other)
    push = push_slopes(made.model, made.linear, FINE_KNOTS)[..., COMMANDED]
    error, limits = unknown_commands(made.linear, push, difference, made.limits)
    linear = made.linear._replace(windows=with_input_error(made.linear.windows, push, error))
    return replace(made, linear=linear, limits=limits, push_error=error)


def check_count(count: int, limits: Thresholds) -> None:
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

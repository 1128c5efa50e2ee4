"""Error of 1 s rollouts on held-out flights (their gap), and the model's own numerical error.

A rollout is a simulated stretch of a flight, from a measured start state. Its start state is fitted
within the measurement noise. The gap is the slow part of the remaining errors, divided by the slow
errors that measurement noise alone gives; so 1 means noise only. "Slow" errors are the projections
of a rollout's errors on Legendre polynomials of time, in which a wrong model shows more than white
noise. The plain errors from the measured start states are reported as well, in metres and so on.
Their noise floor is the noise of the start states, carried through the rollout by the model's
Jacobian.

The numerical error is estimated by step doubling (Hairer, Norsett & Wanner 1993, Sec. II.4). A
rollout with time steps of twice the length, and with every second rotor speed, differs from the
usual rollout by several times the error of the usual one. The part of this difference that no
change of the start state explains is a lower limit of the noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from eval.effects.log_faults import pose_delay
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.colour import Noise, measured_noise
from suite.diagnose.data.whitening import (
    Linearisation,
    make_whitening,
    project_out_start,
    rotor_spread,
    slow_energy,
    whiten,
)
from suite.diagnose.data.windows import (
    LENGTH_S,
    SLICES,
    STATE,
    STATE_GROUPS,
    FlightWindows,
    cut,
    take,
)
from suite.diagnose.estimate.block import Estimate
from suite.diagnose.evidence.rollouts import RolloutModel, block_of
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.gap import Channel, Gap, rms_length

HORIZONS_S = (0.1, 0.5, 1.0)
"""Times after the start at which plain errors are reported [s]."""
SHOWN = 4
"""Number of held-out flights in pictures and recordings."""
ACC_ROW = 9
"""The acceleration at a window's start is computed from the velocities there and in this row,
counted among the rows with a velocity."""
MEASURE = (
    "RMS of slow errors of 1 s rollouts on held-out data, start free within its noise, over "
    "position, attitude, velocity and rates, in units of what measurement noise gives"
)


@dataclass(frozen=True)
class Rollouts:
    """Flights, the model that simulates them as rollouts, and the held-out part of the flights."""

    model: RolloutModel
    """Model of the nominal vehicle."""
    logs: Sequence[FlightLog]
    vehicle: Vehicle
    """The nominal vehicle, which the simulation uses."""
    rotor_input: bool
    """Whether measured rotor speeds are the model's input, not the commands."""
    held: FlightWindows
    """Overlapping 1 s windows of the held-out part."""
    since_s: float
    """Time in a flight at which its held-out part begins [s]; above 0 only for a single flight."""
    limits: Thresholds

    @property
    def start(self) -> np.ndarray:
        """(P,) parameters of the vehicle file."""
        return self.model.space.array("start")

    def cut(self, stride_s: float, only: Sequence[int] | None = None) -> FlightWindows:
        """Return windows that begin every `stride_s` [s], of all flights or those in `only`."""
        settings = (self.rotor_input, stride_s, self.limits, self.model.integrator)
        windows, _ = cut(self.logs, self.vehicle, *settings, only=only)
        assert windows is not None  # the diagnosis has cut them before
        return windows

    def simulated(self, fitted: np.ndarray | None) -> tuple[FlightWindows, dict[str, np.ndarray]]:
        """Return 1 s windows of some held-out flights, and their errors by label of the model.

        The errors are measured - simulated (W, N, 19). One entry is with the vehicle file's
        parameters. If other parameters `fitted` (P,) are given, a second entry is with these.
        """
        windows = self.cut(LENGTH_S, np.unique(self.held.flight)[:SHOWN].tolist())
        windows = take(windows, np.asarray(windows.start_s) >= self.since_s - 1e-6)
        series = {"simulated as given": self.start}
        if fitted is not None:
            series["simulated with the named effects"] = fitted
        return windows, {
            label: self.model.residual(theta, true_starts(self.model, theta, windows), windows)
            for label, theta in series.items()
        }


def measure(
    model: RolloutModel,
    theta: np.ndarray,
    windows: FlightWindows,
    noise: Noise,
    limits: Thresholds = THRESHOLDS,
) -> Gap:
    """Return the gap of `model` on `windows` at the parameters `theta` (P,), given the noise."""
    offset = true_starts(model, theta, windows)
    linear = model.linearise(theta, offset, windows, model.starts)
    return gap_of(linear, windows, noise, limits)


def gap_of(
    linear: Linearisation,
    windows: FlightWindows,
    noise: Noise,
    limits: Thresholds = THRESHOLDS,
) -> Gap:
    """Return the gap of the residuals in `linear`, which has slopes along the start states only.

    The score contains pose, velocity and rates only. The energy, by which models are compared,
    contains every fitted channel, because a bias of the accelerometer changes no other channel.
    """
    whitening = make_whitening(linear, noise, windows, limits)
    residual = block_of(whitening, linear, (), windows).residual
    slow = slow_energy(whitening, residual)
    score = slow[:, :STATE].sum(axis=1) / whitening.slow_freedom[:, :STATE].sum(axis=1)
    free_noise = start_noise(noise.sigma, windows, linear.offset.shape[1], limits)
    channels = {}
    for horizon_s in HORIZONS_S:
        rows = rows_at(windows, horizon_s)
        error = linear.residual[rows][:, :STATE]
        floor = np.maximum(noise_floor(linear.slope[rows][:, :STATE], free_noise), 1e-12)
        channels[f"{horizon_s:g} s"] = {
            name: Channel(*(rms_length(part[:, SLICES[name]]) for part in (error, floor)))
            for name in STATE_GROUPS
        }
    return Gap(score, slow.sum(axis=1), channels)


def overlap(limits: Thresholds) -> float:
    """Return the weight of a window in sums, so that rows in several windows count once."""
    return limits.gap_stride_s / LENGTH_S


def true_starts(model: RolloutModel, theta: np.ndarray, windows: FlightWindows) -> np.ndarray:
    """Return the true start states minus the logged ones, (W, F), given the delay of logged poses.

    The delay is an effect (the clock offset) with its value in `theta` (P,). Over the delay,
    position and attitude change by velocity and rates, and the velocity by the acceleration.
    """
    delay_s = pose_delay(model.space.effects(theta))
    offset = np.zeros((len(windows.flight), model.free))
    offset[:, :3] = delay_s * windows.vel_w
    offset[:, 3:6] = delay_s * windows.rate_b
    has_vel = np.asarray(windows.valid)[:, :, SLICES["velocity"].start]
    row_rank = np.minimum(ACC_ROW, has_vel.sum(axis=1))[:, None]
    row = (has_vel & (np.cumsum(has_vel, axis=1) == row_rank)).argmax(axis=1)
    window = np.arange(len(row))
    span_s = np.asarray(windows.row_s)[window, row][:, None]
    acc_w = (np.asarray(windows.row_vel_w)[window, row] - windows.vel_w) / np.maximum(span_s, 1e-3)
    offset[:, 6:9] = delay_s * np.where(has_vel.any(axis=1, keepdims=True), acc_w, 0.0)
    return offset


def rows_at(windows: FlightWindows, horizon_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of each window, and of its row nearest to `horizon_s` [s], (W,) each."""
    row = np.abs(np.asarray(windows.row_s) - horizon_s).argmin(axis=1)
    return np.arange(len(row)), row


def start_noise(
    sigma: np.ndarray, windows: FlightWindows, free: int, limits: Thresholds = THRESHOLDS
) -> np.ndarray:
    """Return the standard deviation (F,) of the errors of a window's start numbers.

    Start numbers are the 12 of the start state, and then errors of the rotor speeds. `free` is
    their number F, and `sigma` (19,) the noise of the channels.
    """
    noise = np.zeros(free)
    noise[:STATE] = np.where(np.isfinite(sigma), sigma, 0.0)[:STATE]
    if free > STATE:
        noise[STATE:] = rotor_spread(windows, limits)
    return noise


def noise_floor(slope: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the RMS errors (..., 12) that a perfect model would still have.

    They have two causes: the noise of the measured start state, carried to this row by `slope`, and
    the noise of the measurement in the row itself. `slope` (..., 12, F) is the derivative of a
    row's state by the F numbers of the start state, and `noise` (F,) their noise. The first 12
    entries of `noise` serve for both causes.
    """
    return np.sqrt(noise[:STATE] ** 2 + ((slope * noise) ** 2).sum(axis=-1))


def with_model_error(
    model: RolloutModel,
    at: Estimate,
    windows: FlightWindows,
    linear: Linearisation,
    coarser: FlightWindows,
    limits: Thresholds,
) -> Thresholds:
    """Return `limits` with the lower limits of the noise raised to the numerical error.

    Args:
        model: the model that simulates the windows.
        at: estimate at which `linear` was computed.
        windows: W stretches.
        linear: residuals and slopes of `windows` along all parameters and start numbers.
        coarser: the same stretches with longer steps and fewer rotor speeds.
        limits: thresholds of the diagnosis.
    """
    noise = measured_noise(linear.residual, linear.start_slope, windows, limits)
    whitening = make_whitening(linear, noise, windows, limits)
    # Difference by longer steps, in units of noise, without changes of the start state.
    difference = model.residual(at.theta, at.free, coarser) - linear.residual
    finite = np.isfinite(difference).all(axis=(1, 2), keepdims=True)
    difference = np.where(finite, difference, 0.0)
    unexplained = project_out_start(whitening, whiten(whitening, difference[..., None]))[..., 0]
    _, rows, channels = difference.shape
    over_noise = unexplained[:, : rows * channels].reshape(difference.shape)
    sigma = np.where(np.isfinite(noise.sigma), noise.sigma, 0.0)
    valid = np.asarray(windows.valid) & finite
    energy = (np.where(valid, over_noise * sigma, 0.0) ** 2).sum(axis=(0, 1))
    # Mean of each channel, and then of each group of channels (three or four of one sensor).
    power = energy / np.maximum(valid.sum(axis=(0, 1)), 1)
    least = [
        max(floor, float(np.sqrt(power[channel].mean())))
        for floor, channel in zip(limits.least_noise, SLICES.values(), strict=True)
    ]
    return replace(limits, least_noise=tuple(least))

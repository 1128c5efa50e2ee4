"""The gap of rollouts on held-out flights, and the model's own numerical error.

The gap is the slow part of the errors of 1 s rollouts, in units of what noise gives: 1 means noise
only. The start state of each rollout is free within its measurement noise. Plain rollouts from
measured states are reported as well, in metres; their error contains the model's error and the
effect of the start's noise, which follows from the model's Jacobian.

A rollout with steps of twice the length and every second rotor speed differs from the usual one by
several times the usual one's error (step doubling; Hairer, Norsett & Wanner 1993, Sec. II.4). The
part that no free start explains is a lower limit of the noise.
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
from suite.diagnose.verdict.gap import Channel, Gap

HORIZONS_S = (0.1, 0.5, 1.0)
"""Lengths of the plain rollouts [s]."""
SHOWN = 4
"""Held-out flights in pictures and recordings."""
MEASURE = (
    "RMS of slow errors of 1 s rollouts on held-out data, start free within its noise, over "
    "position, attitude, velocity and rates, in units of what measurement noise gives"
)


@dataclass(frozen=True)
class Rollouts:
    """Flights as rollouts: the model, and what was held out."""

    model: RolloutModel
    """Of the nominal vehicle."""
    logs: Sequence[FlightLog]
    vehicle: Vehicle
    """The nominal one."""
    rotor_input: bool
    """Whether measured rotor speeds are the model's input, not the commands."""
    held: FlightWindows
    """Overlapping windows over what was held out."""
    since_s: float
    """From when on a flight is held out: more than 0 of a lone one [s]."""
    limits: Thresholds

    @property
    def start(self) -> np.ndarray:
        """(P,) the parameters of the vehicle file."""
        return self.model.space.array("start")

    def cut(self, stride_s: float, only: Sequence[int] | None = None) -> FlightWindows:
        """Return windows of all flights or of `only` some, one every `stride_s` [s]."""
        how = (self.rotor_input, stride_s, self.limits, self.model.integrator)
        windows, _ = cut(self.logs, self.vehicle, *how, only=only)
        assert windows is not None  # the diagnosis has cut them before
        return windows

    def simulated(self, fitted: np.ndarray | None) -> tuple[FlightWindows, dict[str, np.ndarray]]:
        """Return windows of 1 s over what was held out, and measured - simulated (W, N, 19).

        As given and, where parameters (P,) were `fitted`, with them, by what it is called.
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
    """Return the gap of `model` at `theta` (P,) on `windows` with `noise`."""
    offset = true_starts(model, theta, windows)
    linear = model.linearise(theta, offset, windows, model.starts)
    return gap_of(linear, windows, noise, limits)


def gap_of(
    linear: Linearisation,
    windows: FlightWindows,
    noise: Noise,
    limits: Thresholds = THRESHOLDS,
) -> Gap:
    """Return the gap of residuals; the slopes in `linear` are those along what is free.

    The score is of pose, velocity and rates. Models are compared by every channel that is fitted:
    a bias of the accelerometer moves no other.
    """
    whitening = make_whitening(linear, noise, windows, limits)
    residual = block_of(whitening, linear, (), windows).residual
    slow = slow_energy(whitening, residual)
    score = slow[:, :STATE].sum(axis=1) / whitening.slow_freedom[:, :STATE].sum(axis=1)
    free = start_noise(noise.sigma, windows, linear.offset.shape[1], limits)
    channels = {}
    for horizon in HORIZONS_S:
        at = at_horizon(windows, horizon)
        error = linear.residual[at][:, :STATE]
        floor = np.maximum(noise_floor(linear.slope[at][:, :STATE], free), 1e-12)
        channels[f"{horizon:g} s"] = {
            name: Channel(_rms(error[:, SLICES[name]]), _rms(floor[:, SLICES[name]]))
            for name in STATE_GROUPS
        }
    return Gap(score, slow.sum(axis=1), channels)


def overlap(limits: Thresholds) -> float:
    """Return the weight of a row in overlapping windows, so that each row counts once."""
    return limits.gap_stride_s / LENGTH_S


def true_starts(model: RolloutModel, theta: np.ndarray, windows: FlightWindows) -> np.ndarray:
    """Return the start states (W, F), relative to the measured ones, under the clock offset."""
    late = pose_delay(model.space.effects(theta))
    offset = np.zeros((len(windows.flight), model.free))
    offset[:, :3] = late * windows.vel_w
    offset[:, 3:6] = late * windows.rate_b
    moving = np.asarray(windows.seen)[:, :, SLICES["velocity"].start]
    # The ninth row that has a velocity, or the last where there are fewer.
    number = np.minimum(9, moving.sum(axis=1))[:, None]
    rows = (moving & (np.cumsum(moving, axis=1) == number)).argmax(axis=1)
    at = np.arange(len(rows))
    span = np.asarray(windows.row_s)[at, rows][:, None]
    acc_w = (np.asarray(windows.row_vel_w)[at, rows] - windows.vel_w) / np.maximum(span, 1e-3)
    offset[:, 6:9] = late * np.where(moving.any(axis=1, keepdims=True), acc_w, 0.0)
    return offset


def at_horizon(windows: FlightWindows, horizon_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return each window's number and its row nearest to `horizon_s` [s], (W,) each."""
    row = np.abs(np.asarray(windows.row_s) - horizon_s).argmin(axis=1)
    return np.arange(len(row)), row


def start_noise(
    sigma: np.ndarray, windows: FlightWindows, free: int, limits: Thresholds = THRESHOLDS
) -> np.ndarray:
    """Return the noise (F,) of the numbers that are free in a window, from the channels' (19,)."""
    noise = np.zeros(free)
    noise[:STATE] = np.where(np.isfinite(sigma), sigma, 0.0)[:STATE]
    if free > STATE:
        noise[STATE:] = rotor_spread(windows, limits)
    return noise


def noise_floor(slope: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the errors (..., 12) of a perfect model by the noise of start and row.

    `slope` is (..., 12, F) along what is free, `noise` (F,) of it; its first 12 are a row's too.
    """
    return np.sqrt(noise[:STATE] ** 2 + ((slope * noise) ** 2).sum(axis=-1))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).sum(axis=-1).mean()))


def with_model_error(
    model: RolloutModel,
    at: Estimate,
    windows: FlightWindows,
    linear: Linearisation,
    coarser: FlightWindows,
    limits: Thresholds,
) -> Thresholds:
    """Return `limits` whose least noise of each group of channels is the model's own error or more.

    Args:
        model: the rollout.
        at: where `linear` was taken.
        windows: W of them.
        linear: residuals and slopes along everything.
        coarser: the same windows, cut more coarsely.
        limits: whose least noise is raised.
    """
    noise = measured_noise(linear.residual, linear.start_slope, windows, limits)
    whitening = make_whitening(linear, noise, windows, limits)
    apart = model.residual(at.theta, at.free, coarser) - linear.residual
    good = np.isfinite(apart).all(axis=(1, 2), keepdims=True)
    apart = np.where(good, apart, 0.0)
    left = project_out_start(whitening, whiten(whitening, apart[..., None]))[..., 0]
    count, rows, channels = apart.shape
    over = left[:, : rows * channels].reshape(apart.shape)
    sigma = np.where(np.isfinite(noise.sigma), noise.sigma, 0.0)
    seen = np.asarray(windows.seen) & good
    power = (np.where(seen, over * sigma, 0.0) ** 2).sum(axis=(0, 1)) / np.maximum(
        seen.sum(axis=(0, 1)), 1
    )
    least = [
        max(floor, float(np.sqrt(power[channel].mean())))
        for floor, channel in zip(limits.least_noise, SLICES.values(), strict=True)
    ]
    return replace(limits, least_noise=tuple(least))

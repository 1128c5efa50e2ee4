"""The gap on flights that took no part, the model's share of it, and what is said of it.

The headline takes rollouts of 1 s whose start is free within what was measured, and the slow part
of their errors, in which a model's error shows: it is 1 where there is noise only. Beside it stand
plain rollouts from measured states, in metres. Their error is what the model got wrong and what
the noise of the start made of it; the second is known from the model's slopes.

A rollout with steps of twice the length and every second rotor speed differs from the usual one by
several times the usual one's error (step doubling; Hairer, Norsett & Wanner 1993, Sec. II.4). What
of it no free start explains is a floor of the noise.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from eval.effects.log_faults import lateness
from suite.diagnose.data.colour import Noise, measured_noise
from suite.diagnose.data.whitening import (
    Linearisation,
    make_whitening,
    project_out_start,
    rotor_spread,
    slow_energy,
    whiten,
)
from suite.diagnose.data.windows import SLICES, STATE, STATE_GROUPS, FlightWindows
from suite.diagnose.estimate.block import Estimate
from suite.diagnose.evidence.rollouts import RolloutModel, block_of
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from suite.diagnose.verdict.residual_structure import ResidualStructure

HORIZONS_S = (0.1, 0.5, 1.0)
"""Lengths of the plain rollouts [s]."""
HEADLINE_S = 1.0
"""Length of the rollouts that make the headline [s]."""
MEASURE = (
    "RMS of slow errors of 1 s rollouts on held-out data, start free within its noise, over "
    "position, attitude, velocity and rates, in units of what measurement noise gives"
)


class Gap(NamedTuple):
    """Errors of a model's rollouts."""

    score: np.ndarray
    """(W,) energy of slow errors over what noise gives."""
    energy: np.ndarray
    """(W,) of slow errors; noise alone gives one for each of their degrees of freedom."""
    table: dict[float, dict[str, tuple[float, float]]]
    """RMS error and noise floor by horizon and group of channels, in its unit."""

    @property
    def rms(self) -> float:
        """Root of the mean score; 1 is the noise floor."""
        return float(np.sqrt(self.score.mean()))

    def ci95(self, seed: int, limits: Thresholds = THRESHOLDS) -> tuple[float, float]:
        """Return the 95 % interval of `rms`, windows drawn in blocks."""
        drawn = np.sqrt(self.score[_blocks(len(self.score), seed, limits)].mean(axis=1))
        low, high = np.quantile(drawn, [0.025, 0.975])
        return float(low), float(high)


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
    """Return the gap of residuals; the slopes in `linear` are those along what is free."""
    whitening = make_whitening(linear, noise, windows, limits)
    residual = block_of(whitening, linear, (), windows).residual
    slow = slow_energy(whitening, residual)
    score = slow.sum(axis=1) / whitening.slow_freedom.sum(axis=1)
    free = start_noise(noise.sigma, windows, linear.offset.shape[1], limits)
    table = {}
    for horizon in HORIZONS_S:
        at = at_horizon(windows, horizon)
        error = linear.residual[at][:, :STATE]
        floor = np.maximum(noise_floor(linear.slope[at][:, :STATE], free), 1e-12)
        table[horizon] = {
            name: (_rms(error[:, SLICES[name]]), _rms(floor[:, SLICES[name]]))
            for name in STATE_GROUPS
        }
    return Gap(score, slow.sum(axis=1), table)


def worse(before: Gap, after: Gap, seed: int = 0, limits: Thresholds = THRESHOLDS) -> bool:
    """Return whether `after` is above `before` on the same windows by more than chance.

    Numbers that were fitted elsewhere raise the error of any other flight by about one each, which
    is no reason to doubt them.
    """
    grown = after.energy - before.energy
    drawn = grown[_blocks(len(grown), seed, limits)].mean(axis=1)
    # Windows overlap: each row of the log counts this often.
    total = grown.sum() * limits.gap_stride_s / HEADLINE_S
    return bool(np.quantile(drawn, 0.025) > 0.0 and total > limits.doubt_chi2)


def true_starts(model: RolloutModel, theta: np.ndarray, windows: FlightWindows) -> np.ndarray:
    """Return where windows start (W, F), off what was measured, by the model's clock offset."""
    late = lateness(model.space.effects(theta))
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
    """Return what the noise of start and row makes of a perfect model's errors, (..., 12).

    `slope` is (..., 12, F) along what is free, `noise` (F,) of it; its first 12 are a row's too.
    """
    return np.sqrt(noise[:STATE] ** 2 + ((slope * noise) ** 2).sum(axis=-1))


def _blocks(count: int, seed: int, limits: Thresholds) -> np.ndarray:
    """Return draws (D, ...) of `count` windows in blocks of neighbours."""
    rng, block = np.random.default_rng(seed), limits.bootstrap_block
    size = (limits.bootstrap_draws, max(1, -(-count // block)))
    first = rng.integers(0, max(count - block + 1, 1), size)
    rows = np.minimum(first[..., None] + np.arange(block), count - 1)
    return rows.reshape(limits.bootstrap_draws, -1)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).sum(axis=-1).mean()))


class Verdict(NamedTuple):
    """A verdict and its reasons."""

    label: str
    """no_gap, named, partly or unknown."""
    share_left: float = 0.0
    """What is left of the gap on held-out flights, see `share_left`: 1 where nothing is
    named, 0 where there is none."""
    where: str | None = None
    """What the residual goes with, in words."""


def verdict_on(
    named: bool,
    slow_errors: tuple[np.ndarray, np.ndarray],
    residual: ResidualStructure,
    gaps: tuple[Gap, Gap],
    rotor_input: bool,
    limits: Thresholds = THRESHOLDS,
) -> Verdict:
    """Return the verdict on what was found and on the structure in what it leaves over.

    Args:
        named: whether something was named.
        slow_errors: as `RolloutEvidence.slow_errors` has them.
        residual: the structure.
        gaps: those before and after it was found.
        rotor_input: whether measured rotor speeds drive.
        limits: from where on structure is none of noise.
    """
    slow, expected = slow_errors
    shape = residual.shapes[0] if residual.shapes else None
    if shape is not None and shape.p_value > limits.shape_p_value:
        shape = None
    coloured = [
        axis
        for axis, p_value in residual.coloured.items()
        if p_value <= limits.colour_p_value and not rotor_input
    ]
    loud = limits.structure_rotor_input if rotor_input else limits.structure
    if not (shape or coloured or slow.sum() / expected.sum() > loud):
        return Verdict("named", share_left(*gaps)) if named else Verdict("no_gap")
    share = share_left(*gaps) if named else 1.0
    where = [shape.label] if shape else []
    if coloured:
        where.append("a changing " + ", ".join(coloured))
    partly = named and share <= limits.unexplained_share
    where = "; ".join(where) or _loudest(slow.sum(axis=0), expected.sum(axis=0))
    return Verdict("partly" if partly else "unknown", share, where)


def with_swing(verdict: Verdict, words: str, named: bool) -> Verdict:
    """Return `verdict` where a force swings, which nothing that is fitted does.

    `words` say how; `named` whether something was named besides.
    """
    where = f"{words}; {verdict.where}" if verdict.where else words
    if verdict.where is None:
        return Verdict(
            "partly" if named else "unknown", verdict.share_left if named else 1.0, where
        )
    return verdict._replace(where=where)


def share_left(before: Gap, after: Gap) -> float:
    """Return how much of the gap above the noise floor is left, 0 to 1."""
    left = max(after.rms - 1.0, 0.0)
    return left / max(before.rms - 1.0, left, 1e-9)


def _loudest(slow: np.ndarray, expected: np.ndarray) -> str:
    """Return the channels with most energy (12,) beyond what is expected, in words."""
    energy = np.maximum(slow / np.maximum(expected, 1e-9) - 1.0, 0.0)
    loudest = [k for k in np.argsort(-energy)[:3] if energy[k] > 0]
    return "errors of " + ", ".join(f"{STATE_GROUPS[k // 3]} {'xyz'[k % 3]}" for k in loudest)


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

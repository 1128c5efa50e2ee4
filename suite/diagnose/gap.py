"""The gap on flights that took no part: rollouts from measured states, in units of their noise.

An error of a rollout is what the model got wrong and what the noise of the measured start made of
it; the second is known from the model's own slopes, and is the noise floor.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from suite.diagnose.model import STATE, Linear, Model
from suite.diagnose.windows import SLICES, Windows

HORIZONS_S = (0.1, 0.5, 1.0)
HEADLINE_S = 0.5
STATES = ("position", "attitude", "velocity", "rates")
DRAWS = 1000
BLOCK = 4
"""Neighbouring windows that are drawn together: they start 0.25 s apart."""
MEASURE = (
    "RMS error of 0.5 s rollouts from measured states on held-out data, over position, attitude, "
    "velocity and rates, each in units of its noise floor"
)


class Gap(NamedTuple):
    """Errors of a model's rollouts."""

    score: np.ndarray
    """(W,) mean square of the errors at 0.5 s over the noise floor's."""
    table: dict[float, dict[str, tuple[float, float]]]
    """RMS error and noise floor by horizon and group of channels, in its unit."""

    @property
    def rms(self) -> float:
        """Root of the mean score; 1 is the noise floor."""
        return float(np.sqrt(self.score.mean()))


def measure(model: Model, theta: np.ndarray, windows: Windows, sigma: np.ndarray) -> Gap:
    """Return the gap of `model` with the numbers `theta` on `windows`."""
    offset = _true_starts(model, theta, windows)
    linear = model.linearise(theta, offset, windows, None)
    table, score = {}, np.zeros(len(offset))
    for horizon in HORIZONS_S:
        error, floor, seen = _errors(linear, windows, sigma, horizon)
        if horizon == HEADLINE_S:
            ratio = np.where(seen, error**2 / floor**2, 0.0)
            score = ratio.sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
        table[horizon] = {
            name: (_rms(error[:, SLICES[name]]), _rms(floor[:, SLICES[name]])) for name in STATES
        }
    return Gap(score, table)


def interval(score: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % interval of the root mean score, windows drawn in blocks."""
    rng = np.random.default_rng(seed)
    count = len(score)
    blocks = max(1, -(-count // BLOCK))
    first = rng.integers(0, max(count - BLOCK + 1, 1), (DRAWS, blocks))
    rows = np.minimum(first[..., None] + np.arange(BLOCK), count - 1).reshape(DRAWS, -1)
    drawn = np.sqrt(score[rows].mean(axis=1))
    low, high = np.quantile(drawn, [0.025, 0.975])
    return float(low), float(high)


def _errors(
    linear: Linear, windows: Windows, sigma: np.ndarray, horizon: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    row = np.abs(np.asarray(windows.row_s) - horizon).argmin(axis=1)
    at = np.arange(len(row))
    error = linear.residual[at, row][:, :12]
    slope = linear.slope[at, row][:, :12, -STATE:]
    known = np.where(np.isfinite(sigma), sigma, 0.0)[:12]
    floor = np.sqrt(known**2 + ((slope * known) ** 2).sum(axis=-1))
    seen = np.asarray(windows.seen)[at, row][:, :12]
    return error, np.maximum(floor, 1e-12), seen


def _true_starts(model: Model, theta: np.ndarray, windows: Windows) -> np.ndarray:
    """Return where windows start if the log's clock is off by the model's offset."""
    late = model.space.effects(theta)["clock_offset"].offset
    offset = np.zeros((len(windows.flight), STATE))
    offset[:, :3] = late * windows.vel_w
    offset[:, 3:6] = late * windows.rate_b
    rows = np.minimum(8, np.asarray(windows.seen)[:, :, 0].sum(axis=1) - 1)
    at = np.arange(len(rows))
    span = np.asarray(windows.row_s)[at, rows][:, None]
    acc_w = (np.asarray(windows.row_vel_w)[at, rows] - windows.vel_w) / np.maximum(span, 1e-3)
    offset[:, 6:9] = late * acc_w
    return offset


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).sum(axis=-1).mean()))

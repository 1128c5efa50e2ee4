"""The gap on flights that took no part: how far rollouts are from the record, and from noise.

The headline takes rollouts of 1 s whose start is free within what was measured, and the slow part
of their errors, in which a model's error shows: it is 1 where there is noise only. Beside it stand
plain rollouts from measured states, in metres. Their error is what the model got wrong and what
the noise of the start made of it; the second is known from the model's slopes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eval.effects.log_faults import lateness
from suite.diagnose.data.windows import SLICES, Windows
from suite.diagnose.fit.model import Linear, Model
from suite.diagnose.fit.normal_equations import make_frame, rotor_spread, sums_of
from suite.diagnose.fit.rollout import STATE

HORIZONS_S = (0.1, 0.5, 1.0)
HEADLINE_S = 1.0
STATES = ("position", "attitude", "velocity", "rates")
DRAWS = 1000
BLOCK = 4
"""Neighbouring windows that are drawn together: they start 0.25 s apart."""
OVERLAP_S = 0.25
"""From one start to the next of the rollouts that measure the gap [s]."""
DOUBT = 25.0
"""A rise of squared errors, in units of the noise, from which a name is doubted."""
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


def measure(model: Model, theta: np.ndarray, windows: Windows, sigma: np.ndarray) -> Gap:
    """Return the gap of `model` with the numbers `theta` on `windows`."""
    offset = true_starts(model, theta, windows)
    linear = model.linearise(theta, offset, windows, model.starts)
    return gap_of(linear, windows, sigma)


def gap_of(linear: Linear, windows: Windows, sigma: np.ndarray) -> Gap:
    """Return the gap of residuals; `linear` has the slopes along what is free, last."""
    frame = make_frame(linear, sigma, windows)
    slow = sums_of(frame, linear, 0).slow
    score = slow.sum(axis=1) / frame.slow_freedom.sum(axis=1)
    table = {}
    for horizon in HORIZONS_S:
        error, floor = _errors(linear, windows, sigma, horizon)
        table[horizon] = {
            name: (_rms(error[:, SLICES[name]]), _rms(floor[:, SLICES[name]])) for name in STATES
        }
    return Gap(score, slow.sum(axis=1), table)


def worse(before: Gap, after: Gap, seed: int = 0) -> bool:
    """Return whether `after` is above `before` on the same windows by more than chance.

    Numbers that were fitted elsewhere raise the error of any other flight by about one each, which
    is no reason to doubt them.
    """
    grown = after.energy - before.energy
    drawn = grown[_blocks(len(grown), seed)].mean(axis=1)
    # Windows overlap: each row of the log counts this often.
    total = grown.sum() * OVERLAP_S / HEADLINE_S
    return bool(np.quantile(drawn, 0.025) > 0.0 and total > DOUBT)


def interval(score: np.ndarray, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % interval of the root mean score, windows drawn in blocks."""
    drawn = np.sqrt(score[_blocks(len(score), seed)].mean(axis=1))
    low, high = np.quantile(drawn, [0.025, 0.975])
    return float(low), float(high)


def _blocks(count: int, seed: int) -> np.ndarray:
    """Return draws (DRAWS, ...) of `count` windows in blocks of neighbours."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, max(count - BLOCK + 1, 1), (DRAWS, max(1, -(-count // BLOCK))))
    rows = np.minimum(first[..., None] + np.arange(BLOCK), count - 1)
    return rows.reshape(DRAWS, -1)


def _errors(
    linear: Linear, windows: Windows, sigma: np.ndarray, horizon: float
) -> tuple[np.ndarray, np.ndarray]:
    row = np.abs(np.asarray(windows.row_s) - horizon).argmin(axis=1)
    at = np.arange(len(row))
    error = linear.residual[at, row][:, :12]
    size = linear.offset.shape[1]
    slope = linear.slope[at, row][:, :12, -size:]
    own = np.where(np.isfinite(sigma), sigma, 0.0)[:12]
    rotors = np.full(size - STATE, rotor_spread(windows) if size > STATE else 0.0)
    known = np.concatenate([own, rotors])
    floor = np.sqrt(own**2 + ((slope * known) ** 2).sum(axis=-1))
    return error, np.maximum(floor, 1e-12)


def true_starts(model: Model, theta: np.ndarray, windows: Windows) -> np.ndarray:
    """Return where windows start if the log's clock is off by the model's offset."""
    late = lateness(model.space.effects(theta))
    offset = np.zeros((len(windows.flight), model.free))
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

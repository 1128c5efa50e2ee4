"""The gap: the errors of one model on flights that took no part in finding or fitting anything.

Each source of evidence computes its own (`suite/diagnose/sources/`): of rollouts the slow errors of
a second, of the force and the torque the errors of mean accelerations.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from suite.diagnose.thresholds import THRESHOLDS, Thresholds


class Channel(NamedTuple):
    """One channel of a gap."""

    error: float
    """RMS, in the channel's unit."""
    floor: float
    """RMS by measurement noise alone."""


class Gap(NamedTuple):
    """Errors of a model on W held-out stretches."""

    score: np.ndarray
    """(W,) mean squared error, in the unit of the floor."""
    energy: np.ndarray
    """(W,) squared error by which models are compared: what belongs to a flight or stretch alone,
    as its trim or its start, is subtracted."""
    channels: Mapping[str, Mapping[str, Channel]]
    """By group and channel."""
    floor: float = 1.0
    """RMS that measurement noise alone gives."""

    @property
    def rms(self) -> float:
        """Root of the mean score."""
        return float(np.sqrt(self.score.mean()))

    def ci95(self, seed: int, limits: Thresholds = THRESHOLDS) -> tuple[float, float]:
        """Return the 95 % interval of `rms`, stretches drawn in blocks."""
        drawn = np.sqrt(self.score[_blocks(len(self.score), seed, limits)].mean(axis=1))
        low, high = np.quantile(drawn, [0.025, 0.975])
        return float(low), float(high)

    def least_energy(self, seed: int, limits: Thresholds = THRESHOLDS) -> float:
        """Return the lower end of the 95 % interval of the mean `energy`."""
        drawn = self.energy[_blocks(len(self.energy), seed, limits)].mean(axis=1)
        return float(np.quantile(drawn, 0.025))

    def above(self, before: Gap, weight: float, seed: int, limits: Thresholds) -> bool:
        """Return whether this is above the gap `before` on the same stretches by more than chance.

        Parameters that were fitted elsewhere raise the error of any other flight by about one each,
        which does not contradict them. Stretches overlap: each row counts `weight` times of one.
        """
        grown = self.energy - before.energy
        drawn = grown[_blocks(len(grown), seed, limits)].mean(axis=1)
        return bool(np.quantile(drawn, 0.025) > 0.0 and grown.sum() * weight > limits.doubt_chi2)


def share_left(before: Gap, after: Gap) -> float:
    """Return the share of the gap above the noise floor that remains, 0 to 1."""
    left = max(after.rms - after.floor, 0.0)
    return left / max(before.rms - before.floor, left, 1e-9)


def _blocks(count: int, seed: int, limits: Thresholds) -> np.ndarray:
    """Return draws (D, ...) of `count` stretches in blocks of neighbours."""
    rng, block = np.random.default_rng(seed), limits.bootstrap_block
    size = (limits.bootstrap_draws, max(1, -(-count // block)))
    first = rng.integers(0, max(count - block + 1, 1), size)
    rows = np.minimum(first[..., None] + np.arange(block), count - 1)
    return rows.reshape(limits.bootstrap_draws, -1)

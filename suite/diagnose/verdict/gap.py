"""How large an error is: the gap on held-out flights, and what an effect does on these flights.

A gap holds the errors of one model on flights that took no part in finding or fitting anything.
Each source of evidence computes its own (`suite/diagnose/sources/`): of rollouts the slow errors of
a second, of the force and the torque the errors of mean accelerations.

With little noise every difference is significant, also the model's numerical errors. An effect is
reported only if it can matter, however small its p-value: it is left out where the upper end of the
95 % interval of its size is below all thresholds (equivalence testing; Lakens 2017, doi
10.1177/1948550617697177).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from suite.diagnose.data.windows import SLICES, FlightWindows
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
        return bool(np.quantile(drawn, 0.025) > 0.0 and grown.sum() * weight > limits.refuting_chi2)


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


FORCE_S, TORQUE_S = 0.5, 0.1
"""Times over which an effect's mean linear and angular accelerations are computed [s]. The second
is short, as the rate loop soon counteracts a rotation."""
DRIFT_S = 1.0
"""When its drift is measured [s]."""


class EffectSize(NamedTuple):
    """RMS over a set of flights of what an effect does."""

    force: float
    """[m/s^2]."""
    torque: float
    """[rad/s^2]."""
    drift: float | None
    """Distance after a second [m]; None where no rollout was flown."""

    def relevant(self, limits: Thresholds) -> bool:
        """Return whether it reaches one of the thresholds."""
        force, torque, drift = limits.relevance
        return self.force >= force or self.torque >= torque or (self.drift or 0.0) >= drift

    def words(self) -> str:
        """Return the size in a line."""
        drift = "" if self.drift is None else f", {self.drift:.2g} m after 1 s"
        return f"{self.force:.2g} m/s^2, {self.torque:.2g} rad/s^2{drift}"


def rollout_size(moved: np.ndarray, windows: FlightWindows) -> EffectSize:
    """Return the size of an effect that moves rollouts by `moved` (W, N, 19).

    A fault of the log has the size of the motion that would change the log as much.
    """
    row_s, seen = np.asarray(windows.row_s), np.asarray(windows.seen)

    def by_time(group: str, horizon_s: float, power: int) -> float:
        """Return the RMS of what a group has moved at its last row within the horizon, per s^n."""
        there = seen[..., SLICES[group]].all(axis=-1) & (row_s <= horizon_s + 1e-6) & (row_s > 0.0)
        last = np.where(there, row_s, 0.0).argmax(axis=1)
        good = there.any(axis=1)
        if not good.any():
            return 0.0
        at = (np.arange(len(last))[good], last[good])
        over = moved[at][:, SLICES[group]] / row_s[at][:, None] ** power
        return float(np.sqrt((over**2).sum(axis=1).mean()))

    force = by_time("velocity", FORCE_S, 1) or 2.0 * by_time("position", FORCE_S, 2)
    felt = seen[..., SLICES["accelerometer"]].all(axis=-1)
    if felt.any():
        acc = moved[felt][:, SLICES["accelerometer"]]
        force = max(force, float(np.sqrt((acc**2).sum(axis=1).mean())))
    return EffectSize(force, by_time("rates", TORQUE_S, 1), by_time("position", DRIFT_S, 2))


def view_size(moved: np.ndarray, in_world: bool) -> EffectSize:
    """Return the size of an effect that changes a view's accelerations by `moved` (M, 3)."""
    rms = float(np.sqrt((moved**2).sum(axis=1).mean()))
    return EffectSize(rms, 0.0, None) if in_world else EffectSize(0.0, rms, None)


def upper_size(
    slope: np.ndarray,
    away: np.ndarray,
    half_width: np.ndarray,
    size_of: Callable[[np.ndarray], EffectSize],
) -> EffectSize:
    """Return the upper end of the interval of an effect's size.

    Args:
        slope: (..., K) of what is compared, along its K parameters.
        away: (K,) how far they are from the vehicle file's.
        half_width: (K,) of their 95 % intervals.
        size_of: the size of what moves by such an array.
    """
    size = size_of(slope @ away)
    wide = [size_of(slope[..., k] * width) for k, width in enumerate(half_width)]
    more = [float(np.sqrt(sum((one[i] or 0.0) ** 2 for one in wide))) for i in range(3)]
    drift = None if size.drift is None else size.drift + more[2]
    return EffectSize(size.force + more[0], size.torque + more[1], drift)

"""Error of a model on held-out flights (the gap), and the size of an effect on these flights.

The gap is the RMS error of one model on flights that took no part in any fit, and is compared with
the error by measurement noise alone. Each source of evidence (`suite/diagnose/sources/`) computes
its own: rollouts from the slow errors of simulated stretches of 1 s, force and torque from the
errors of mean accelerations.

With little noise every difference is significant, also the model's numerical errors. So an effect
is left out, however small its p-value, if the upper end of the 95 % interval of its size is below
all thresholds of relevance (equivalence testing; Lakens 2017, doi 10.1177/1948550617697177).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from suite.diagnose.data.windows import SLICES, FlightWindows
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


def rms_length(vectors: np.ndarray) -> float:
    """Return the root mean square length of `vectors` (..., K), in their unit."""
    return float(np.sqrt((vectors**2).sum(axis=-1).mean()))


class Channel(NamedTuple):
    """Error of one channel of a gap, as the position after 1 s."""

    error: float
    """RMS, in the channel's unit."""
    floor: float
    """RMS by measurement noise alone."""


class Gap(NamedTuple):
    """Errors of a model on W held-out stretches of flight."""

    score: np.ndarray
    """(W,) mean squared error, in the unit of the floor."""
    energy: np.ndarray
    """(W,) squared error by which models are compared. What belongs to one flight or stretch alone,
    such as its trim or its start state, is subtracted."""
    channels: Mapping[str, Mapping[str, Channel]]
    """By group of channels (such as a horizon) and channel."""
    floor: float = 1.0
    """RMS by measurement noise alone."""

    @property
    def rms(self) -> float:
        """Root of the mean score."""
        return float(np.sqrt(self.score.mean()))

    def ci95(self, seed: int, limits: Thresholds = THRESHOLDS) -> tuple[float, float]:
        """Return the 95 % interval of `rms` by a block bootstrap over stretches."""
        low, high = np.quantile(np.sqrt(_bootstrap_means(self.score, seed, limits)), [0.025, 0.975])
        return float(low), float(high)

    def energy_low95(self, seed: int, limits: Thresholds = THRESHOLDS) -> float:
        """Return the lower end of the 95 % interval of the mean `energy`."""
        return float(np.quantile(_bootstrap_means(self.energy, seed, limits), 0.025))

    def exceeds(self, before: Gap, weight: float, seed: int, limits: Thresholds) -> bool:
        """Return whether the energy is significantly larger than that of `before`.

        Parameters that were fitted to other flights raise the squared error by about one each,
        which does not contradict them: the rise has to be larger than that.

        Args:
            before: gap of another model on the same stretches.
            weight: share of a stretch that no other one overlaps, so that each row counts once.
            seed: of the bootstrap.
            limits: least significant rise.
        """
        rise = self.energy - before.energy
        rise_low = np.quantile(_bootstrap_means(rise, seed, limits), 0.025)
        return bool(rise_low > 0.0 and rise.sum() * weight > limits.refuting_chi2)


def remaining_share(before: Gap, after: Gap) -> float:
    """Return the share of the gap above the noise floor that remains, 0 to 1."""
    remaining = max(after.rms - after.floor, 0.0)
    return remaining / max(before.rms - before.floor, remaining, 1e-9)


def _bootstrap_means(values: np.ndarray, seed: int, limits: Thresholds) -> np.ndarray:
    """Return the means (D,) of draws of `values` (W,) in blocks of neighbouring stretches."""
    rng, block = np.random.default_rng(seed), limits.bootstrap_block
    blocks = max(1, -(-len(values) // block))
    first = rng.integers(0, max(len(values) - block + 1, 1), (limits.bootstrap_draws, blocks))
    rows = np.minimum(first[..., None] + np.arange(block), len(values) - 1)
    return values[rows.reshape(limits.bootstrap_draws, -1)].mean(axis=1)


FORCE_S, TORQUE_S = 0.5, 0.1
"""Times over which an effect's mean linear and angular accelerations are computed [s]. The second
is short, as the rate loop soon counteracts a rotation."""
DRIFT_S = 1.0
"""Time after which an effect's drift is measured [s]."""


class EffectSize(NamedTuple):
    """RMS over a set of flights of the accelerations and the drift that an effect causes."""

    force: float
    """Linear acceleration [m/s^2]."""
    torque: float
    """Angular acceleration [rad/s^2]."""
    drift: float | None
    """Distance after a second [m]; None where no rollout was flown."""

    def relevant(self, limits: Thresholds) -> bool:
        """Return whether the size reaches one of the thresholds of relevance."""
        force, torque, drift = limits.relevance
        return self.force >= force or self.torque >= torque or (self.drift or 0.0) >= drift

    def words(self) -> str:
        """Return the size as a line for people."""
        drift = "" if self.drift is None else f", {self.drift:.2g} m after 1 s"
        return f"{self.force:.2g} m/s^2, {self.torque:.2g} rad/s^2{drift}"


def rollout_size(shift: np.ndarray, windows: FlightWindows) -> EffectSize:
    """Return the size of an effect that shifts the simulated values of `windows`.

    A fault of the log has the size of the motion that would change the log as much.

    Args:
        shift: (W, N, 19) difference that the effect makes, by channel.
        windows: W stretches of 1 s.
    """
    row_s, valid = np.asarray(windows.row_s), np.asarray(windows.valid)

    def growth(group: str, horizon_s: float, power: int) -> float:
        """Return the RMS shift of a group at its last row in the horizon, over time^power."""
        in_time = (row_s <= horizon_s + 1e-6) & (row_s > 0.0)
        usable = valid[..., SLICES[group]].all(axis=-1) & in_time
        last_row = np.where(usable, row_s, 0.0).argmax(axis=1)
        stretch = np.flatnonzero(usable.any(axis=1))
        if not len(stretch):
            return 0.0
        row = (stretch, last_row[stretch])
        return rms_length(shift[row][:, SLICES[group]] / row_s[row][:, None] ** power)

    force = growth("velocity", FORCE_S, 1) or 2.0 * growth("position", FORCE_S, 2)
    has_acc = valid[..., SLICES["accelerometer"]].all(axis=-1)
    if has_acc.any():
        force = max(force, rms_length(shift[has_acc][:, SLICES["accelerometer"]]))
    return EffectSize(force, growth("rates", TORQUE_S, 1), growth("position", DRIFT_S, 2))


def view_size(shift: np.ndarray, in_world: bool) -> EffectSize:
    """Return the size of an effect that shifts a view's mean accelerations by `shift` (M, 3).

    A view is the force alone (`in_world`) or the torque alone.
    """
    rms = rms_length(shift)
    return EffectSize(rms, 0.0, None) if in_world else EffectSize(0.0, rms, None)


def upper_size(
    slope: np.ndarray,
    change: np.ndarray,
    half_width: np.ndarray,
    size_of: Callable[[np.ndarray], EffectSize],
) -> EffectSize:
    """Return the upper end of the 95 % interval of an effect's size.

    Args:
        slope: (..., K) derivative of the simulated values along the effect's K parameters.
        change: (K,) fitted parameters less those of the vehicle file.
        half_width: (K,) of the parameters' 95 % intervals.
        size_of: size of an effect from the shift (...) of the simulated values.
    """
    size = size_of(slope @ change)
    by_width = [size_of(slope[..., k] * width) for k, width in enumerate(half_width)]
    force, torque, drift = (
        float(np.sqrt(sum((one[i] or 0.0) ** 2 for one in by_width))) for i in range(3)
    )
    total_drift = None if size.drift is None else size.drift + drift
    return EffectSize(size.force + force, size.torque + torque, total_drift)

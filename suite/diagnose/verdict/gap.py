"""Error of a model on held-out flights (the gap), and the size of an effect on these flights.

The gap is the RMS error of a model on held-out flights, which took no part in any fit. It is
compared with the error that measurement noise alone gives (the noise floor). That of force or
torque is the error of mean accelerations, without each flight's constant offset (trim). That of
rollouts, which simulate 1 s from a measured start state, is the slow part of their errors, divided
by the slow errors that noise alone gives; so 1 means noise only. "Slow" errors are the projections
of a rollout's errors on Legendre polynomials of time, in which a wrong model shows more than white
noise; the start state is free within its noise. The plain errors from the measured start states are
reported as well, in metres and so on. Their noise floor is the noise of the start states, carried
through the rollout by the model's Jacobian.

The size of an effect is how much it changes these flights. With little noise every difference is
significant, even the model's numerical errors. So an effect is not named, however small its
p-value, if the upper end of the 95 % interval of its size is below all thresholds of relevance
(equivalence testing; Lakens 2017, doi 10.1177/1948550617697177).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from suite.diagnose.data.noise import Linearisation, Noise
from suite.diagnose.data.whitening import block_of, make_whitening, nuisance_of, slow_energy
from suite.diagnose.data.windows import LENGTH_S, SLICES, STATE, STATE_GROUPS, FlightWindows, take
from suite.diagnose.estimate.gauss_newton import Z95
from suite.diagnose.evidence.rollouts import RolloutModel, start_estimate
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from tracks.common.figures import rounded

DRAWS = 1000
"""Number of draws of a bootstrap."""
FORCE_S, TORQUE_S = 0.5, 0.1
"""Times over which an effect's mean linear and angular accelerations are computed [s]. The time for
the angular one is short, as the rate loop soon counteracts a rotation."""
OPEN_FORCE_S = 0.2
"""The time for the linear one if measured rotor speeds drive the simulation [s]. No rate loop stops
a rotation then: it tilts the thrust, and soon moves the drone more than the effect's own force."""


def rms_length(vectors: np.ndarray, z: float = 0.0) -> float:
    """Return the root mean square length of `vectors` (..., K), in their unit.

    With `z` it is an upper limit, by that many standard errors of the mean square.
    """
    squares = (vectors**2).sum(axis=-1)
    return float(np.sqrt(squares.mean() + z * squares.std() / np.sqrt(squares.size)))


class Channel(NamedTuple):
    """Error of a model in one channel, such as the position after 1 s."""

    error: float
    """RMS error, in the channel's unit."""
    floor: float
    """RMS error that measurement noise alone gives, in the channel's unit."""


class Gap(NamedTuple):
    """Errors of a model on W held-out stretches of flight."""

    score: np.ndarray
    """(W,) mean squared error of each stretch, without trims, in the squared unit of `floor`."""
    energy: np.ndarray
    """(W,) squared error of each stretch, by which models are compared, without its trim (constant
    force or torque) or start state."""
    channels: Mapping[str, Mapping[str, Channel]]
    """Error of each channel, by group (such as the time since the start) and channel."""
    floor: float = 1.0
    """RMS error that measurement noise alone gives."""
    offset: float = 0.0
    """RMS of the flights' trims, which are no part of `score`; 0 if none are subtracted."""
    together: int = 4
    """Number of neighbouring stretches that a bootstrap draws together, as their errors are
    correlated. Four rollouts that begin every 0.25 s overlap."""

    @property
    def rms(self) -> float:
        """RMS error over all stretches: the root of the mean score."""
        return float(np.sqrt(self.score.mean()))

    @property
    def total(self) -> float:
        """RMS error over all stretches, with the flights' trims."""
        return float(np.hypot(self.rms, self.offset))

    def ci95(self, seed: int) -> tuple[float, float] | None:
        """Return the 95 % interval of `rms` by a block bootstrap; None of a single stretch."""
        if len(self.score) < 2:
            return None
        low, high = np.quantile(np.sqrt(self._means(self.score, seed)), [0.025, 0.975])
        return float(low), float(high)

    def energy_low95(self, seed: int) -> float:
        """Return the lower end of the 95 % interval of the mean `energy`."""
        return float(np.quantile(self._means(self.energy, seed), 0.025))

    def exceeds(self, before: Gap, weight: float, limits: Thresholds) -> bool:
        """Return whether the energy is significantly larger than that of `before`.

        A fitted parameter raises the error of other flights by about one even if the model is
        right, so the rise has to be clearly larger. `weight` makes rows in overlapping stretches
        count once.
        """
        rise = self.energy - before.energy
        rise_low = np.quantile(self._means(rise, 0), 0.025)
        return bool(rise_low > 0.0 and rise.sum() * weight > limits.refuting_chi2)

    def _means(self, values: np.ndarray, seed: int) -> np.ndarray:
        """Return the means (DRAWS,) of bootstrap draws of `values` (W,), one of each stretch.

        The values form a circle, so that each is drawn equally often; of few, fewer together.
        """
        rng, count = np.random.default_rng(seed), len(values)
        block = max(1, min(self.together, count // 4))
        block_start = rng.integers(0, count, (DRAWS, -(-count // block), 1))
        rows = (block_start + np.arange(block)).reshape(DRAWS, -1)[:, :count] % count
        return values[rows].mean(axis=1)


def remaining_share(before: Gap, after: Gap) -> float:
    """Return the share (0 to 1) of the gap `before` above the noise floor that remains `after`."""
    remaining = max(after.rms - after.floor, 0.0)
    return remaining / max(before.rms - before.floor, remaining, 1e-9)


def from_true_starts(
    model: RolloutModel, theta: np.ndarray, windows: FlightWindows, indices: Sequence[int] = ()
) -> Linearisation:
    """Return the residuals of `windows` from their true start states (see `start_estimate`).

    The slopes are along the parameters at `indices` and then along the start numbers.
    """
    at = start_estimate(model, windows, theta)
    return model.linearise(at, windows, [*indices, *model.starts])


def start_correction(
    model: RolloutModel, theta: np.ndarray, windows: FlightWindows, noise: Noise, limits: Thresholds
) -> np.ndarray:
    """Return corrections (W, F) of the true start states, fitted to all rows of each window.

    The noise of a measured start state grows along a rollout. So each number of the state gets the
    correction that fits the model with `theta` (P,) best, of at most three sigma where it was
    measured. Windows in which the model diverges, and rotor speeds, are not corrected.
    """
    linear = from_true_starts(model, theta, windows)
    flies = np.isfinite(linear.residual).all(axis=(1, 2))
    flies &= np.isfinite(linear.slope).all(axis=(1, 2, 3))
    correction = np.zeros_like(linear.offset)
    if flies.any():
        linear = take(linear, flies)
        whitening = make_whitening(linear, noise, limits)
        best = block_of(whitening, linear, ()).free[:, :STATE]
        most = 3.0 * np.nan_to_num(noise.sigma[:STATE], nan=np.inf)
        correction[flies, :STATE] = np.clip(best, -most, most)
    return correction


def gap_of(linear: Linearisation, noise: Noise, limits: Thresholds = THRESHOLDS) -> Gap:
    """Return the gap of the residuals in `linear`, which has slopes along the start states only.

    The score is that of pose, velocity and rates. The energy, by which models are compared, has
    every fitted channel: a bias of the accelerometer changes no other.
    """
    windows, whitening = linear.windows, make_whitening(linear, noise, limits)
    slow = slow_energy(whitening, block_of(whitening, linear, ()).residual)
    score = slow[:, :STATE].sum(axis=1) / whitening.slow_freedom[:, :STATE].sum(axis=1)
    # Noise of the start state, and errors of the inputs.
    slope, spread = nuisance_of(linear, limits)
    free_noise = np.append(np.nan_to_num(noise.sigma[:STATE]), spread)
    channels: dict[str, dict[str, Channel]] = {}
    for horizon_s in (0.1, 0.5, 1.0):
        channels[f"{horizon_s:g} s"] = {}
        distance_s = np.abs(np.asarray(windows.row_s) - horizon_s)
        for name in STATE_GROUPS:
            # A signal that is slower than the rows was not measured in each of them.
            measured = np.all(np.asarray(windows.valid)[..., SLICES[name]], axis=-1)
            stretch = np.flatnonzero(measured.any(axis=1))
            nearest = np.where(measured, distance_s, np.inf)[stretch].argmin(axis=1)
            rows = (stretch, nearest)
            error = linear.residual[rows][:, SLICES[name]]
            floor = noise_floor(slope[rows][:, :STATE], free_noise)[:, SLICES[name]]
            parts = (error, np.maximum(floor, 1e-12)) if len(stretch) else (np.zeros((1, 3)),) * 2
            channels[f"{horizon_s:g} s"][name] = Channel(*map(rms_length, parts))
    return Gap(score, slow.sum(axis=1), channels)


def overlap(windows: FlightWindows) -> float:
    """Return the weight of a window in sums, so that rows in several windows count once."""
    step_s = np.diff(windows.start_s)[np.diff(windows.flight) == 0]
    return float(np.minimum(step_s / LENGTH_S, 1.0).mean()) if len(step_s) else 1.0


def noise_floor(slope: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the RMS errors (..., 12) that a perfect model would still have.

    `slope` (..., 12, F) is the derivative of a row's state by the F start numbers, and carries
    their `noise` (F,) to this row. The first 12 are also the noise of the row itself.
    """
    return np.sqrt(noise[:STATE] ** 2 + ((slope * noise) ** 2).sum(axis=-1))


class EffectSize(NamedTuple):
    """RMS over a set of flights of the accelerations and the drift that an effect causes."""

    force: float
    """Change of the linear acceleration [m/s^2]."""
    torque: float
    """Change of the angular acceleration [rad/s^2]."""
    drift: float | None
    """Change of the position after a second [m]; None where commands drove no rollout."""

    def relevant(self, limits: Thresholds) -> bool:
        """Return whether the size reaches one of the thresholds of relevance."""
        force, torque, drift = limits.relevance
        return self.force >= force or self.torque >= torque or (self.drift or 0.0) >= drift

    def words(self) -> str:
        """Return the size as text for people."""
        values = {"m/s²": self.force, "rad/s²": self.torque, "m after one second": self.drift}
        parts = [f"{rounded(value, 2)} {unit}" for unit, value in values.items() if value]
        parts = parts or ["nothing"]
        return " and ".join([*([", ".join(parts[:-1])] if parts[1:] else []), parts[-1]])


def rollout_size(
    shift: np.ndarray, windows: FlightWindows, rotor_input: bool, z: float = 0.0
) -> EffectSize:
    """Return the size of an effect that shifts the values of `windows` by `shift` (W, N, 19).

    A fault of the log gets that of the motion with the same shift. With `rotor_input`, rollouts
    have no rate loop, and a torque moves them much further than the drone: there is no drift. For
    `z` see `rms_length`.
    """
    row_s, valid = np.asarray(windows.row_s), np.asarray(windows.valid)

    def growth(group: str, horizon_s: float, power: int) -> float:
        """Return the RMS shift of a group, over time^power.

        It is that at its last row in the horizon, or at its first row if that is later.
        """
        usable = valid[..., SLICES[group]].all(axis=-1) & (row_s > 0.0)
        in_time = usable & (row_s <= horizon_s + 1e-6)
        last_row = np.where(in_time, row_s, 0.0).argmax(axis=1)
        chosen = np.where(in_time.any(axis=1), last_row, usable.argmax(axis=1))
        stretch = np.flatnonzero(usable.any(axis=1))
        if not len(stretch):
            return 0.0
        row = (stretch, chosen[stretch])
        return rms_length(shift[row][:, SLICES[group]] / row_s[row][:, None] ** power, z)

    force_s = OPEN_FORCE_S if rotor_input else FORCE_S
    # The velocity grows with the acceleration times t, the position with half of it times t^2.
    force = growth("velocity", force_s, 1) or 2.0 * growth("position", force_s, 2)
    has_acc = valid[..., SLICES["accelerometer"]].all(axis=-1)
    if has_acc.any():
        force = max(force, rms_length(shift[has_acc][:, SLICES["accelerometer"]], z))
    drift = None if rotor_input else growth("position", 1.0, 2)
    return EffectSize(force, growth("rates", TORQUE_S, 1), drift)


def upper_size(
    slope: np.ndarray,
    change: np.ndarray,
    factor: np.ndarray,
    size_of: Callable[..., EffectSize],
) -> EffectSize:
    """Return the upper end of the 95 % interval of the size of an effect with K parameters.

    `slope` (..., K) is the derivative of the simulated values, `change` (K,) the fitted parameters
    minus those of the vehicle file, and `factor` (K, L) their joint uncertainty, see
    `Intervals.factor`: what two parameters cause may cancel. `size_of` takes a shift (...) of the
    simulated values, and `z` as in `rms_length`, to its size.
    """
    size = size_of(slope @ change, z=Z95)
    widths = [size_of(slope @ direction) for direction in factor.T]
    force, torque, drift = (
        float(np.sqrt(sum((one[i] or 0.0) ** 2 for one in widths))) for i in range(3)
    )
    total_drift = None if size.drift is None else size.drift + drift
    return EffectSize(size.force + force, size.torque + torque, total_drift)


def beyond_error(change: np.ndarray, error: np.ndarray, width: np.ndarray) -> bool:
    """Return whether an effect, or a shape of the residual, is more than the model's own error.

    It is if a 95 % interval of `change` (K,), of half-width `width`, does not contain zero when it
    is widened by `error` at both ends. Where no parameter is significant by itself, one has to
    change by more than the error.
    """
    distance = np.abs(change)
    least = width if (distance > width).any() else 0.0
    return bool((distance - error > least).any())


def less_error(change: np.ndarray, error: np.ndarray | float) -> np.ndarray:
    """Return `change` (K,) moved towards zero by the model's own `error`, at most to zero."""
    return np.sign(change) * np.maximum(np.abs(change) - error, 0.0)

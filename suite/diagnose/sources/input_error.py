"""Errors of rollouts by their inputs: steps, rotor speeds and commands that no log contains.

If the drone received commands between the rows of the log, these are taken as the mean of their
neighbours. The true ones gave another thrust and torque. How large they are is estimated by a
comparison with commands that hold until the next row, since the truth lies about as far on the
other side. Thrust and torque at the knots of a window become nuisance parameters of this size, and
what changes faster than the knots counts as noise. Commands at uncertain times (jitter) have such
an error, too; there the comparison is with commands whose times are shifted by chance.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from suite.diagnose.data.noise import Linearisation, Noise, measured_noise
from suite.diagnose.data.whitening import Whitening, block_of, make_whitening, project_out
from suite.diagnose.data.windows import KNOTS, SLICES, FlightWindows
from suite.diagnose.estimate.block import Estimate
from suite.diagnose.evidence.rollouts import RolloutModel
from suite.diagnose.thresholds import Thresholds

WIDE = 100.0
"""Standard deviation of an unknown thrust [m/s^2] and torque [rad/s^2] that data determine."""
FORCE, COMMANDED = slice(0, 3), slice(2, 6)
"""Axes of a push: those of a force, and those of the thrust and torque by commands."""
LEAST_PUSH = 1e-3
"""Lower limit of the error of thrust [m/s^2] and torque [rad/s^2]."""


def with_model_error(
    linear: Linearisation, difference: np.ndarray, limits: Thresholds
) -> Thresholds:
    """Return `limits` with the lower limits of the noise raised to the model's numerical error.

    It is estimated by step doubling (Hairer, Norsett & Wanner 1993, Sec. II.4): longer steps and
    fewer rotor speeds change the residuals by the `difference` (W, N, 19), several times the error.
    `linear` has slopes along all parameters and start numbers.
    """
    noise = measured_noise(linear, limits)
    whitening = make_whitening(linear, noise, limits)
    return _raised(_unexplained_rms(difference, linear, noise, whitening), limits)


class Share(NamedTuple):
    """Estimated share of commands between the rows of logs."""

    value: float
    error: float
    """Standard error of `value`, which includes the misfit."""

    def are_lacking(self, limits: Thresholds) -> bool:
        """Return whether logs certainly lack commands."""
        return self.value - 3.0 * self.error > limits.lacking_share

    def are_complete(self, limits: Thresholds) -> bool:
        """Return whether logs certainly have every command."""
        return self.value + 3.0 * self.error <= limits.held_share


def share_between(
    linear: Linearisation, difference: np.ndarray, push: np.ndarray, limits: Thresholds
) -> Share:
    """Return the share of commands between the rows.

    The share is 0 if each command holds until the next row, and 1 if the mean of two commands acts
    half-way, as it does on average if the drone received others in between. This changes the
    residuals by the `difference` (W, N, 19). The share is fitted together with all parameters,
    since a delay or a shifted clock moves commands in time as well; and with a force and a torque
    of any course over the knots, since commands in between differ from the mean, and something may
    act that no parameter describes. If the share is uncertain then, the torque is left out.
    `linear` has slopes along all parameters and start numbers; for `push` see `push_slopes`.
    """
    noise = measured_noise(linear, limits)
    toward = -_zeroed(difference)[0][..., None]
    # Along all parameters and the share; slopes along start numbers are not needed any more.
    slope = np.concatenate([toward, linear.slope[..., : -linear.offset.shape[1]]], axis=-1)
    share = _share(linear, slope, push, noise, limits)
    if 3.0 * share.error > limits.held_share:
        share = _share(linear, slope, push[..., FORCE], noise, limits)
    return share


def _share(
    linear: Linearisation, slope: np.ndarray, push: np.ndarray, noise: Noise, limits: Thresholds
) -> Share:
    """Return the share; `slope` (W, N, 19, 1 + K) is along it and K parameters."""
    linear = linear._replace(windows=with_input_error(linear.windows, push, WIDE))
    whitening = make_whitening(linear, noise, limits)
    rows, _ = project_out(whitening, linear._replace(slope=slope), slope.shape[-1])
    rows = rows.reshape(-1, rows.shape[-1])
    rows = rows[:, np.r_[True, True, (rows[:, 2:] ** 2).sum(axis=0) > 0.0]]
    size = np.linalg.norm(rows[:, 1:], axis=0)
    slope, residual = rows[:, 1:] / size, rows[:, 0]
    inverse = np.linalg.pinv(slope.T @ slope, rcond=1e-9, hermitian=True)
    best = inverse @ (slope.T @ residual)
    # What remains may be more than noise.
    free = linear.offset.size + push[:, 0, 0].size + len(best)
    freedom = int(np.asarray(linear.windows.valid).sum()) - free
    chi2 = float(((residual - slope @ best) ** 2).sum())
    scale = np.sqrt(max(chi2 / max(freedom, 1), 1.0))
    error = scale * np.sqrt(inverse[0, 0]) / size[0]
    return Share(float(best[0] / size[0]), float(error))


def push_slopes(model: RolloutModel, linear: Linearisation) -> np.ndarray:
    """Return slopes (W, N, 19, KNOTS, 6) along a push at a knot: force [m/s^2], torque [rad/s^2].

    `FORCE` and `COMMANDED` are parts of its axes.
    """
    at = Estimate(model.space.array("start"), linear.offset)
    slope = model.respond(at, linear.windows)[0].slope
    return slope.reshape(*slope.shape[:3], KNOTS, 6)


def with_input_error(
    windows: FlightWindows, push: np.ndarray, error: np.ndarray | float
) -> FlightWindows:
    """Return `windows` with further errors of the input, of the size `error` (W, K), (K,) or ().

    For `push` (W, N, 19, KNOTS, K) see above.
    """
    count, *_, width = push.shape
    columns = push * np.broadcast_to(error, (count, width))[:, None, None, None]
    columns = columns.reshape(*push.shape[:3], -1)
    if windows.input_error is not None:
        columns = np.concatenate([windows.input_error, columns], axis=-1)
    return windows._replace(input_error=columns)


def unknown_commands(
    linear: Linearisation, push: np.ndarray, difference: np.ndarray, limits: Thresholds
) -> tuple[np.ndarray, Thresholds]:
    """Return the error (W, 4) of thrust and torque by unknown commands, and limits with its noise.

    Other commands, which are as likely, change the residuals by the `difference` (W, N, 19). For
    `push` see `push_slopes`; its axes are `COMMANDED`.
    """
    noise = measured_noise(linear, limits)
    difference, _ = _zeroed(difference)
    linear = linear._replace(residual=difference)

    def with_error(error: np.ndarray | float) -> tuple[Linearisation, Whitening]:
        wide = linear._replace(windows=with_input_error(linear.windows, push, error))
        return wide, make_whitening(wide, noise, limits)

    wide, whitening = with_error(WIDE)
    _, change = project_out(whitening, wide)
    values = WIDE * change[:, -KNOTS * 4 :, 0].reshape(-1, KNOTS, 4)
    power = (values**2).mean(axis=1)
    # A window's own error counts as much as that of all windows.
    error = np.maximum(np.sqrt(0.5 * (power + power.mean(axis=0))), LEAST_PUSH)
    known, whitening = with_error(error)
    return error, _raised(_unexplained_rms(difference, known, noise, whitening), limits)


def _unexplained_rms(
    errors: np.ndarray, linear: Linearisation, noise: Noise, whitening: Whitening
) -> np.ndarray:
    """Return the RMS (6,) by sensor (of `SLICES`) of the part that no start state explains.

    `errors` are (W, N, 19); windows that diverge are left out. It is 0 where nothing was measured.
    """
    errors, known = _zeroed(errors)
    unexplained = block_of(whitening, linear._replace(residual=errors), ()).residual
    _, rows, channels = errors.shape
    over_noise = unexplained[:, : rows * channels].reshape(errors.shape)
    sigma = np.where(np.isfinite(noise.sigma), noise.sigma, 0.0)
    valid = np.asarray(linear.windows.valid) & known
    energy = (np.where(valid, over_noise * sigma, 0.0) ** 2).sum(axis=(0, 1))
    # Mean of each channel, and then of each group of channels (three or four of one sensor).
    power = energy / np.maximum(valid.sum(axis=(0, 1)), 1)
    return np.array([np.sqrt(power[channel].mean()) for channel in SLICES.values()])


def _zeroed(errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `errors` (W, N, 19), 0 in windows that diverge, and which (W, 1, 1) do not."""
    known = np.asarray(np.isfinite(errors).all(axis=(1, 2), keepdims=True))
    return np.where(known, errors, 0.0), known


def _raised(error: np.ndarray, limits: Thresholds) -> Thresholds:
    """Return `limits` with lower limits of the noise of at least `error` (6,)."""
    return replace(limits, least_noise=tuple(np.maximum(limits.least_noise, error).tolist()))

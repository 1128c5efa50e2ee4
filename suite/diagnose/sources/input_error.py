"""Errors of rollouts by their inputs: steps, rotor speeds and commands that no log contains.

If the drone received commands between the rows of the log, these are taken as the mean of their
neighbours. The true ones gave another thrust and torque. It is estimated by a comparison with
commands that hold until the next row, since the truth lies about as far on the other side. Thrust
and torque at the knots of a window become nuisance parameters of this size, and what changes faster
than the knots counts as noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from suite.diagnose.data.noise import Linearisation, Noise, measured_noise
from suite.diagnose.data.whitening import Whitening, block_of, make_whitening
from suite.diagnose.data.windows import SLICES, STATE
from suite.diagnose.thresholds import Thresholds

WIDE = 100.0
"""Standard deviation of an unknown thrust [m/s^2] and torque [rad/s^2] that data determine."""


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


def lacks_commands(linear: Linearisation, difference: np.ndarray, limits: Thresholds) -> bool:
    """Return whether the drone received commands between the rows of the log.

    With every second command the residuals change by the `difference` (W, N, 19). Body rates and
    rotor speeds follow a command at once. If their residuals are only a small share of the
    difference, the log has every command. For `linear` see `with_model_error`.
    """
    noise = measured_noise(linear, limits)
    whitening = make_whitening(linear, noise, limits)
    rms = _unexplained_rms(difference, linear, noise, whitening)
    residual = _unexplained_rms(linear.residual, linear, noise, whitening)
    shares = residual / np.maximum(rms, 1e-12)
    fast = [s for n, s in zip(SLICES, shares, strict=True) if n in ("rates", "rotor speed")]
    return min((share for share in fast if share > 0.0), default=0.0) >= limits.held_share


def unknown_commands(
    linear: Linearisation, difference: np.ndarray, limits: Thresholds
) -> tuple[np.ndarray, Thresholds]:
    """Return `FlightWindows.push_error` (W, 4) of unknown commands, and limits with their noise.

    Held commands change the residuals by the `difference` (W, N, 19). `linear` has slopes along
    unknown thrusts and torques at the knots.
    """
    noise = measured_noise(linear, limits)
    difference = np.where(np.isfinite(difference).all(axis=(1, 2), keepdims=True), difference, 0.0)

    def with_error(error: np.ndarray) -> Linearisation:
        windows = linear.windows._replace(push_error=error)
        return linear._replace(residual=difference, windows=windows)

    wide = with_error(np.full((len(difference), 4), WIDE))
    push = block_of(make_whitening(wide, noise, limits), wide, ()).free[:, STATE + 4 :]
    power = (push.reshape(len(push), -1, 4) ** 2).mean(axis=1)
    # A window's own error counts as much as that of all windows.
    error = np.sqrt(0.5 * (power + power.mean(axis=0)))
    known = with_error(error)
    left = _unexplained_rms(difference, known, noise, make_whitening(known, noise, limits))
    return error, _raised(left, limits)


def _unexplained_rms(
    errors: np.ndarray, linear: Linearisation, noise: Noise, whitening: Whitening
) -> np.ndarray:
    """Return the RMS (6,) by sensor (of `SLICES`) of the part that no start state explains.

    `errors` are (W, N, 19); windows that diverge are left out. It is 0 where nothing was measured.
    """
    known = np.isfinite(errors).all(axis=(1, 2), keepdims=True)
    errors = np.where(known, errors, 0.0)
    unexplained = block_of(whitening, linear._replace(residual=errors), ()).residual
    _, rows, channels = errors.shape
    over_noise = unexplained[:, : rows * channels].reshape(errors.shape)
    sigma = np.where(np.isfinite(noise.sigma), noise.sigma, 0.0)
    valid = np.asarray(linear.windows.valid) & known
    energy = (np.where(valid, over_noise * sigma, 0.0) ** 2).sum(axis=(0, 1))
    # Mean of each channel, and then of each group of channels (three or four of one sensor).
    power = energy / np.maximum(valid.sum(axis=(0, 1)), 1)
    return np.array([np.sqrt(power[channel].mean()) for channel in SLICES.values()])


def _raised(error: np.ndarray, limits: Thresholds) -> Thresholds:
    """Return `limits` with lower limits of the noise of at least `error` (6,)."""
    return replace(limits, least_noise=tuple(np.maximum(limits.least_noise, error).tolist()))

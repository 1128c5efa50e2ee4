"""Estimates the model's own error in rollouts, and raises the noise floor to it.

The numerical error is estimated by step doubling (Hairer, Norsett & Wanner 1993, Sec. II.4). A
rollout with time steps of twice the length, and with every second rotor speed, differs from the
usual rollout by several times the error of the usual one. The part of this difference that no
change of the start state explains is a lower limit of the noise.

Commands are held from one row of the log to the next. If the drone received commands between the
rows, their times are wrong by up to the spacing of the rows. The error is estimated in the same
way, with every second command. If one command was left out after each row, the true error is half
of that. The share is estimated from the body rates and rotor speeds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from suite.diagnose.data.noise import Linearisation, Noise, at_least, measured_noise
from suite.diagnose.data.whitening import Whitening, block_of, make_whitening, slow_energy
from suite.diagnose.data.windows import SLICES
from suite.diagnose.thresholds import Thresholds


def with_model_error(linear: Linearisation, coarser: np.ndarray, limits: Thresholds) -> Thresholds:
    """Return `limits` with the lower limits of the noise raised to the model's error.

    `linear` has slopes along all parameters and start numbers; `coarser` (W, N, 19) are the
    residuals with longer steps and fewer rotor speeds.
    """
    noise = measured_noise(linear, limits)
    whitening = make_whitening(linear, noise, limits)
    return _raised(_rms(_difference(linear, coarser), linear, noise, whitening), limits)


def with_held_commands(
    linear: Linearisation, fewer: np.ndarray, limits: Thresholds
) -> Thresholds | None:
    """Return `limits` with the noise raised to the error of held commands; None without the error.

    Body rates and rotor speeds follow a command at once. So their residuals, relative to their
    change with `fewer` (every second command), limit the error's share of that change. With a small
    share, the log has every command. For `linear` see `with_model_error`.
    """
    noise = measured_noise(linear, limits)
    whitening = make_whitening(linear, noise, limits)
    difference = _difference(linear, fewer)
    rms = _rms(difference, linear, noise, whitening)
    residual = _rms(linear.residual, linear, noise, whitening)
    shares = residual / np.maximum(rms, 1e-12)
    fast = [s for n, s in zip(SLICES, shares, strict=True) if n in ("rates", "rotor speed")]
    share = min((share for share in fast if share > 0.0), default=0.0)
    if share < limits.held_share:
        return None
    # The error accumulates along a window, so its slow part exceeds that of white noise.
    share = min(share, 1.0)
    rms, difference = share * rms, np.nan_to_num(share * difference)
    raised = _raised(rms, limits)
    noise = Noise(at_least(noise.sigma, raised), {})
    whitening = make_whitening(linear, noise, raised)
    block = block_of(whitening, linear._replace(residual=difference), ())
    slow = slow_energy(whitening, block.residual).sum(axis=0)
    expected = np.maximum(whitening.slow_freedom.sum(axis=0), 1e-9)
    factor = [np.sqrt(max(slow[c].sum() / expected[c].sum(), 1.0)) for c in SLICES.values()]
    return _raised(rms * np.array(factor), limits)


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


def _difference(linear: Linearisation, other: np.ndarray) -> np.ndarray:
    """Return by how much the residuals `other` (W, N, 19) differ; NaN where one diverges."""
    difference = other - linear.residual
    finite = np.isfinite(difference).all(axis=(1, 2), keepdims=True)
    return np.where(finite, difference, np.nan)


def _rms(
    errors: np.ndarray, linear: Linearisation, noise: Noise, whitening: Whitening
) -> np.ndarray:
    """Return the RMS (6,) by sensor (of `SLICES`) of the part that no start state explains.

    `errors` are (W, N, 19), without windows with NaN; the RMS is 0 where nothing was measured.
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

"""The model's own numerical error, by what twice the step and half of the rotor speeds do.

Between rows the rotors' course is not known, and the integrator's steps have a length. A rollout
with steps of twice the length and every second rotor speed differs from the usual one by several
times the usual one's error (step doubling; Hairer, Norsett & Wanner 1993, Sec. II.4). What of it no
free start explains is a floor of the noise: differences below it are the model's and no vehicle's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from suite.diagnose.data.colour import measured_noise
from suite.diagnose.data.whitening import Linearisation, make_whitening, project_out_start, whiten
from suite.diagnose.data.windows import SLICES, FlightWindows
from suite.diagnose.estimate.block import Estimate
from suite.diagnose.evidence.rollout_model import RolloutModel
from suite.diagnose.thresholds import Thresholds


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

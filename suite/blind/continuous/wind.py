"""The air's own motion: a steady wind, and gusts that are coloured to first order."""

from __future__ import annotations

from typing import Any

import numpy as np

UPRIGHT = 0.5
"""Vertical intensity over the horizontal one."""
SLOWEST = 1.0
"""Airspeed below which gusts change no slower [m/s]."""


class Wind:
    """Wind on N flights, known at the ends of each step and linear between them."""

    def __init__(self, effects: dict[str, Any], count: int, rng: np.random.Generator) -> None:
        """Prepare; gusts start from their stationary distribution."""
        steady = effects["constant_wind"].velocity if "constant_wind" in effects else (0.0,) * 3
        self._steady_w = np.asarray(steady, dtype=float)
        self._gusts, self._rng = effects.get("gusts"), rng
        self._gust_w = np.zeros((count, 3))
        if self._gusts is not None:
            self._gust_w = self._intensity * rng.standard_normal((count, 3))
        self.still = self._gusts is None and not self._steady_w.any()
        """Whether no air ever moves."""

    @property
    def _intensity(self) -> np.ndarray:
        assert self._gusts is not None
        return float(self._gusts.intensity) * np.array([1.0, 1.0, UPRIGHT])

    @property
    def now_w(self) -> np.ndarray:
        """(N, 3) [m/s]."""
        return self._steady_w + self._gust_w

    def step(self, vel_w: np.ndarray, length_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the wind (N, 3) at the start and at the end of a step, and go there [m/s].

        dw/dt = -w / tau + noise with tau = length / max(airspeed, 1), exact for a constant tau.

        Args:
            vel_w: (N, 3) of the vehicles [m/s].
            length_s: (N, 1) of the step [s].
        """
        before = self._gust_w
        if self._gusts is not None:
            air_w = vel_w - self._steady_w
            airspeed = np.sqrt((air_w * air_w).sum(axis=1, keepdims=True))
            rate = np.maximum(airspeed, SLOWEST) / float(self._gusts.length)
            kept = np.exp(-length_s * rate)
            drawn = self._intensity * self._rng.standard_normal(before.shape)
            self._gust_w = kept * before + np.sqrt(1.0 - kept**2) * drawn
        return self._steady_w + before, self._steady_w + self._gust_w

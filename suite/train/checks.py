"""Settings that no training can be made with are refused before anything is compiled."""

from __future__ import annotations

import functools
import math
from typing import Any

from suite.train.config import TrainConfig

SHARE = (0.0, 1.0)
LIMITS = {
    "seed": (0, 2**32 - 1),
    "optimizer.iterations": (1, math.inf),
    "optimizer.warmup": (0, math.inf),
    "episode.batch": (1, math.inf),
    "episode.steps": (1, math.inf),
    "episode.gates": (1, 8),
    "episode.gate_corners": (3, math.inf),
    "episode.difficulty": SHARE,
    "episode.easy_until": SHARE,
    "episode.rest_share": SHARE,
    "episode.stop_from": SHARE,
    "episode.missed_share": SHARE,
    "episode.sharp_share": SHARE,
    "episode.bare_share": SHARE,
    "episode.hairpin_share": SHARE,
    "episode.density": (0.0, math.inf),
    "episode.height_spread": (0.0, math.inf),
    "episode.start_speed": (0.0, math.inf),
    "loss.path_samples": (1, math.inf),
    "physics.action_delay": (0.0, 2.0),
    "physics.state_delay": (0, math.inf),
    "physics.image_delay": (0, math.inf),
}
"""The least and the most that is allowed, both included unless infinite."""


def check(config: TrainConfig) -> None:
    """Refuse settings outside their limits, and ranges that end before they begin.

    Raises:
        ValueError: naming the setting, its value and what is allowed.
    """
    for path, (low, high) in LIMITS.items():
        value: Any = functools.reduce(getattr, path.split("."), config)
        ends = value if isinstance(value, tuple) else (value,)
        allowed = f"{low:g} and more" if math.isinf(high) else f"{low:g} to {high:.10g}"
        if not all(low <= end <= high and math.isfinite(end) for end in ends):
            raise ValueError(f"{path} is {value}, allowed are {allowed}")
        if list(ends) != sorted(ends):
            raise ValueError(f"{path} is {value}; give the lower end of the range first")


def check_stride(stride: int, steps: int) -> None:
    """Refuse an `episode.image_stride` that does not divide `episode.steps`.

    Raises:
        ValueError: naming both.
    """
    if stride < 1 or steps % stride:
        raise ValueError(
            f"episode.image_stride is {stride}, allowed are divisors of episode.steps ({steps})"
        )

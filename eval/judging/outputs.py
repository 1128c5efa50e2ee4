"""What a policy's outputs look like over trials: whether they are limited and scaled.

Outputs of the wrong unit fly, badly, and look like a policy that has not learned. Their size and
their mean along the vertical show which of the usual mistakes it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from eval.judging.guard import Guarded
from eval.worlds.trial import TrialResult
from policies.spec import ActionSpec, Doubt

LIMITED_MOST = 0.05
"""Share of limited actions above which there is a warning."""
UNIT = 1.0 + 1e-6
"""Outputs of a policy that are never larger are those of an action space from -1 to 1."""
UP_MOST = 6.0
"""A mean vertical acceleration above this contains gravity [m/s^2]: what is wanted over a flight
changes the velocity, which stays small."""


class Outputs:
    """What is summed up of the outputs in N slots, until a trial ends."""

    def __init__(self, slots: int, action: ActionSpec) -> None:
        self._is_acceleration = action.kind == "acceleration"
        self._count = np.zeros(slots, int)
        self._largest, self._up = np.zeros(slots), np.zeros(slots)

    def start(self, slot: int) -> None:
        """Begin a trial in `slot`."""
        self._count[slot], self._largest[slot], self._up[slot] = 0, 0.0, 0.0

    def add(self, guarded: Guarded, state: np.ndarray) -> None:
        """Add one answer of every slot, for the observations `state` (N, spec.state_size)."""
        self._count += ~guarded.late
        self._largest = np.fmax(self._largest, guarded.largest)
        if self._is_acceleration:
            self._up += (state[:, 3:6] * guarded.action_b).sum(-1)

    def columns(self, slot: int) -> dict[str, Any]:
        """Return what a `TrialResult` says of the outputs in `slot`."""
        count = int(self._count[slot])
        up = float(self._up[slot]) / count if count and self._is_acceleration else np.nan
        return {
            "decisions": count,
            "output_max": float(self._largest[slot]) if count else np.nan,
            "action_up": up,
        }


def actions_of(results: Sequence[TrialResult], action: ActionSpec) -> dict[str, Any]:
    """Return what one policy's trials say of its outputs: shares, and warnings with their fix."""
    decisions = sum(row.decisions for row in results)
    if not decisions:
        return {"decisions": 0, "limited": None, "bad": None, "warnings": []}
    limited = sum(row.limited_actions for row in results) / decisions
    bad = sum(row.bad_actions for row in results) / decisions
    return {
        "decisions": decisions,
        "limited": limited,
        "bad": bad,
        "warnings": _warnings(results, action, limited, bad),
    }


def _warnings(
    results: Sequence[TrialResult], action: ActionSpec, limited: float, bad: float
) -> list[Doubt]:
    found, plain = [], action.kind == "acceleration" and action.is_plain
    if limited > LIMITED_MOST:
        twice = "" if action.is_plain else ", and that module and contract do not both scale it"
        seen, fix = f"{limited:.0%} of its actions were limited", "check the unit of its output"
        found.append(Doubt("action_limited", seen, fix + twice))
    if bad:
        seen = f"{bad:.1%} of its actions were not finite and the last good one was flown"
        found.append(Doubt("action_not_finite", seen, "check its weights and its normalisation"))
    if plain and max(row.output_max for row in results) <= UNIT:
        seen = "its outputs are always within -1 to 1 m/s^2 and look unscaled"
        fix = "export it with the contract of its environment, or give action.scale"
        found.append(Doubt("action_scale", seen, fix))
    up = float(np.median([row.action_up for row in results]))
    if plain and up > UP_MOST:
        seen = f"its outputs contain gravity: {up:.1f} m/s^2 upwards on average"
        fix = "an action is the net acceleration: subtract 9.81 along the state's world_z"
        found.append(Doubt("action_gravity", seen, fix))
    return found

"""What the outputs and the memory of a policy show in its flights."""

from __future__ import annotations

from collections.abc import Container, Sequence
from typing import Any

import numpy as np

from eval.judging.guard import Guarded
from eval.judging.policy_checks.responses import UP_B, VEL_B
from eval.worlds.trial import TrialResult
from policies.policy import Hidden, Policy, Wrapper
from policies.spec import ActionSpec, Note

LIMITED_MOST = 0.05
"""Share of limited actions above which there is a warning."""
UNIT = 1.0 + 1e-6
"""Outputs up to this size are probably those of an action space from -1 to 1."""
UP_MOST = 6.0
"""Above this mean vertical acceleration [m/s^2], outputs probably contain gravity. A decision at
which the vehicle does not climb enters the mean as 0, since even a correct policy commands upwards
while a vehicle with too little thrust sinks."""
EXTREME, LEAST_DECISIONS = 0.999, 20
"""Share of an output's own largest size that counts as extreme; smallest number of decisions."""
OFTEN = 0.5
"""Share of extreme outputs above which the policy probably saturates."""

UNIT_FIX = "check the unit of its output"
SCALE_FIX = (
    "export it with the contract (units, scales, frames) of its environment, or set action.scale; "
    "after a very short training this is no fault"
)
"""Advice (with `UNIT_FIX`) for outputs of a wrong scale and of a wrong unit."""
INPUTS = "; or its state or image has other units, signs or order than the contract"
"""Other cause of outputs with a wrong direction or offset."""
GRAVITY_FIX = f"an action is net acceleration: subtract 9.81 along the state's world_z{INPUTS}"
"""Advice for outputs that contain gravity."""


class Outputs:
    """Statistics of the outputs of the current trial in each of N slots."""

    def __init__(self, slots: int, action: ActionSpec) -> None:
        self._is_acceleration = action.kind == "acceleration"
        self._count = np.zeros(slots, int)
        self._largest, self._up = np.zeros(slots), np.zeros(slots)
        self._faults = np.zeros((slots, 3), int)

    def start(self, slot: int) -> None:
        """Reset the statistics of `slot` for a new trial."""
        self._count[slot], self._largest[slot], self._up[slot] = 0, 0.0, 0.0
        self._faults[slot] = 0

    def add(self, guarded: Guarded, state: np.ndarray) -> None:
        """Add one output of every slot, with its state observation (N, spec.state_size)."""
        self._count += ~guarded.late
        self._largest = np.fmax(self._largest, guarded.largest)
        self._faults += np.stack([guarded.bad, guarded.limited, guarded.late], axis=-1)
        if self._is_acceleration:
            climbs = ~guarded.late & ((state[:, UP_B] * state[:, VEL_B]).sum(-1) > 0.0)
            self._up += climbs * (state[:, UP_B] * guarded.action_b).sum(-1)

    def columns(self, slot: int) -> dict[str, Any]:
        """Return the fields of `TrialResult` for the outputs in `slot`."""
        count = int(self._count[slot])
        up = float(self._up[slot]) / count if count and self._is_acceleration else 0.0
        bad, limited, late = map(int, self._faults[slot])
        faults = {"bad_actions": bad, "limited_actions": limited, "late_actions": late}
        largest = float(self._largest[slot])
        return {"decisions": count, "output_max": largest, "action_up": up, **faults}


def action_report(
    results: Sequence[TrialResult], action: ActionSpec, known: Container[str] = ()
) -> dict[str, Any]:
    """Return the shares of limited and bad actions, and warnings except of `known` faults."""
    decisions = sum(row.decisions for row in results)
    if not decisions:
        return {"decisions": 0, "limited": None, "bad": None, "warnings": []}
    limited = sum(row.limited_actions for row in results) / decisions
    bad = sum(row.bad_actions for row in results) / decisions
    warnings = [n for n in _warnings(results, action, limited, bad) if n.fault not in known]
    return {"decisions": decisions, "limited": limited, "bad": bad, "warnings": warnings}


def scale_advice(action: ActionSpec) -> str:
    """Return advice against scaling an action twice."""
    return "" if action.is_plain else "; scale it once, by the network or by action.scale"


def _warnings(
    results: Sequence[TrialResult], action: ActionSpec, limited: float, bad: float
) -> list[Note]:
    """Return warnings about the outputs in flight."""
    notes, plain = [], action.kind == "acceleration" and action.is_plain
    largest = [row.output_max for row in results]
    if limited > LIMITED_MOST:
        text = f"{limited:.0%} of its actions were limited"
        notes.append(Note("action_limited", text, UNIT_FIX + scale_advice(action)))
    if bad:
        text = f"{bad:.1%} of its actions were not finite; the last valid one was used"
        notes.append(Note("action_not_finite", text, "check its weights and its normalisation"))
    if plain and 0.0 < max(largest) <= UNIT:
        text = "all its outputs are within -1 to 1 m/s^2 and are probably unscaled"
        notes.append(Note("action_scale", text, SCALE_FIX))
    up = float(np.median([row.action_up for row in results]))
    if plain and up > UP_MOST:
        text = f"its outputs contain gravity: {up:.1f} m/s^2 upwards while it climbs"
        notes.append(Note("action_gravity", text, GRAVITY_FIX))
    return notes


class Watched(Wrapper):
    """Flies as `policy` does, and keeps its outputs and whether its memory changes."""

    def __init__(self, policy: Policy) -> None:
        super().__init__(policy)
        self._outputs: list[np.ndarray] = []
        self._has_memory = self._remembers = False

    def act(
        self, hidden: Hidden, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, Hidden]:
        """Return what the policy's `act` returns."""
        output, new_hidden = super().act(hidden, state, image, fresh)
        self._outputs.append(np.asarray(output).astype(float))
        if isinstance(hidden, np.ndarray) and hidden[~fresh].size:
            self._has_memory = True
            self._remembers |= not np.array_equal(new_hidden[~fresh], hidden[~fresh])
        return output, new_hidden

    def doubts(self) -> list[Note]:
        """Return a note if most outputs are at their component's own largest size."""
        outputs = np.abs(np.concatenate([*self._outputs, np.zeros((0, self.spec.action.size))]))
        largest = outputs.max(0, initial=0.0)
        if len(outputs) < LEAST_DECISIONS or not largest.min() > 0.0:  # also for NaN
            return []
        share = (outputs >= EXTREME * largest).mean()
        if share <= OFTEN:
            return []
        text = f"{share:.0%} of its outputs are at their own largest values"
        fix = "its last layer saturates or is constant: check the units and order of its inputs"
        return [Note("action_saturated", text, fix)]

    def hints(self) -> list[Note]:
        """Return a note if the policy has a memory that never changes."""
        if not self._has_memory or self._remembers:
            return []
        fix = "return the new memory as hidden_next, if it is recurrent"
        return [Note("memory_constant", "its memory never changes in flight", fix)]

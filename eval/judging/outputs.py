"""What a policy's outputs look like over trials: whether they are limited and scaled.

Outputs of the wrong unit fly, badly, and look like a policy that has not learned. Their size and
their mean along the vertical show which of the usual mistakes it is; so do a few made-up
observations, level flight towards a gate to one side: whoever flies through it accelerates there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np

from eval.judging.guard import ActionLimits, Guarded
from eval.worlds.trial import TrialResult
from policies.policy import Policy
from policies.spec import ActionSpec, Note, PolicySpec

LIMITED_MOST = 0.05
"""Share of limited actions above which there is a warning."""
UNIT = 1.0 + 1e-6
"""Outputs of a policy that are never larger are those of an action space from -1 to 1."""
UP_MOST = 6.0
"""A mean vertical acceleration above this contains gravity [m/s^2]: what is wanted over a flight
changes the velocity, which stays small."""


LIFT = 3.0
"""Whoever wants more than this upwards, even towards a gate below, counts gravity in [m/s^2]."""
CLEAR = 0.5
"""Differences of an output between two sides below this say nothing [m/s^2]."""
UNIT_FIX = "check the unit of its output"
TIMES, ALIKE = 1.5, 1e-3
"""Another image, and the share of what other images change within which an answer is the same."""
ASIDE_M, AHEAD_M, SPEED, STEPS = 2.0, 6.0, 3.0, 10
"""How far aside and ahead the gate is [m], the speed towards it [m/s], and the steps of memory."""


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
        up = float(self._up[slot]) / count if count and self._is_acceleration else 0.0
        return {
            "decisions": count,
            "output_max": float(self._largest[slot]),
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


def _twice(action: ActionSpec) -> str:
    return "" if action.is_plain else ", and that module and contract do not both scale it"


def _warnings(
    results: Sequence[TrialResult], action: ActionSpec, limited: float, bad: float
) -> list[Note]:
    found, plain = [], action.kind == "acceleration" and action.is_plain
    largest = [row.output_max for row in results]
    if limited > LIMITED_MOST:
        seen = f"{limited:.0%} of its actions were limited"
        found.append(Note("action_limited", seen, UNIT_FIX + _twice(action)))
    if bad:
        seen = f"{bad:.1%} of its actions were not finite and the last good one was flown"
        found.append(Note("action_not_finite", seen, "check its weights and its normalisation"))
    if plain and 0.0 < max(largest) <= UNIT:
        seen = "its outputs are always within -1 to 1 m/s^2 and look unscaled"
        fix = "export it with the contract of its environment, or give action.scale"
        found.append(Note("action_scale", seen, fix))
    up = float(np.median([row.action_up for row in results]))
    if plain and up > UP_MOST:
        seen = f"its outputs contain gravity: {up:.1f} m/s^2 upwards on average"
        fix = "an action is the net acceleration: subtract 9.81 along the state's world_z"
        found.append(Note("action_gravity", seen, fix))
    return found


@runtime_checkable
class FromFile(Protocol):
    """A policy that was read from a file."""

    notes: tuple[Note, ...]


def notes_of(policy: Policy) -> tuple[Note, ...]:
    """Return what is assumed of a policy's file, and what its answers look like."""
    return (*policy.notes, *doubts(policy)) if isinstance(policy, FromFile) else ()


def doubts(policy: Policy) -> tuple[Note, ...]:
    """Return every usual mistake of unit and frame that the policy's answers look like."""
    if policy.spec.action.kind != "acceleration":
        return ()
    name = policy.name
    action, output = probed(policy)
    left, right, above, below, _ = action
    if not np.isfinite(action).all():
        seen = f"{name}: answers NaN or infinity in level flight towards a gate"
        return (Note("action_not_finite", seen, "check its weights and its normalisation"),)
    largest = float(np.linalg.norm(action, axis=-1).max())
    if largest > ActionLimits().size:
        seen = f"{name}: wants up to {largest:.0f} m/s^2 in level flight, more than the limit"
        return (Note("action_limited", seen, UNIT_FIX + _twice(policy.spec.action)),)
    found = []
    aside, up = left[1] - right[1], above[2] - below[2]
    if aside < -CLEAR and up < -CLEAR:
        seen = (
            f"{name}: accelerates away from gates to its left and above, as if its action were FRD"
        )
        found.append(Note("action_frame", seen, "the suite's is FLU: negate y and z"))
    elif min(aside, up) < -CLEAR:
        axis, side = ("y", "left") if aside < up else ("z", "up")
        seen = f"{name}: accelerates away from a gate aside along {axis}, as if {axis} were negated"
        found.append(Note("action_frame", seen, f"the suite's {axis} points {side}: negate it"))
    if action[:, 2].min() > LIFT:
        seen = (
            f"{name}: wants {action[:, 2].min():.1f} m/s^2 upwards and more in level flight, as if "
        )
        fix = "an action is the net acceleration: subtract 9.81 along the state's world_z"
        found.append(Note("action_gravity", seen + "its action contained gravity", fix))
    if policy.spec.action.is_plain and np.abs(output).max() <= UNIT:
        seen = f"{name}: answers within -1 to 1 m/s^2 to gates far aside, as if unscaled"
        fix = "export it with the contract of its environment, or give action.scale"
        found.append(Note("action_scale", seen, fix))
    if _divides_images(policy):
        seen = f"{name}: answers alike to an image and to {TIMES:g} times that image"
        fix = "without its scale an image says nothing of distance: do not divide by its maximum"
        found.append(Note("image_scale", seen, fix))
    return tuple(found)


def _divides_images(policy: Policy) -> bool:
    """Return whether a policy makes all multiples of an image one, but sees what is in it."""
    spec = policy.spec
    rows = np.linspace(0.5, 2.0, spec.image_shape[-2])[:, None]
    falling = np.broadcast_to(rows if not spec.depth.uint8 else 50 * rows, spec.image_shape)
    image = np.stack([falling, TIMES * falling, np.flip(falling, -2)]).astype(np.float32)
    answers = _answers(policy, _level(spec, np.zeros((len(image), 2))), image)[1][0]
    multiple, turned = np.abs(answers[1:] - answers[0]).max(-1)
    return bool(multiple < ALIKE * turned)


def probed(policy: Policy) -> tuple[np.ndarray, np.ndarray]:
    """Return the last actions (5, 3) [m/s^2] and all outputs (STEPS, 5, 3) that led to them.

    The rows are gates to the left, to the right, above, below and straight ahead.
    """
    spec = policy.spec
    aside = ASIDE_M * np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [0, 0]])
    far = 0.0 if spec.depth.uint8 else spec.depth.bounds(spec.camera.range_m)[0]
    image = np.full((len(aside), *spec.image_shape), far, np.float32)
    return _answers(policy, _level(spec, aside), image)


def _level(spec: PolicySpec, aside: np.ndarray) -> np.ndarray:
    """Return states of level flight towards gates that are `aside` (N, 2): to the left, up [m]."""
    state = np.zeros((len(aside), spec.state_size), np.float32)
    state[:, 0], state[:, 5] = SPEED, 1.0
    state[:, 6], state[:, 7:9] = AHEAD_M, aside
    first = spec.base_size
    for key, numbers in (("second_gate", 3), ("gate_axis", 3), ("second_axis", 3)):
        if getattr(spec, key):
            state[:, first : first + numbers] = (1, 0, 0)
            if key == "second_gate":
                state[:, first : first + 3] = state[:, 6:9] + (AHEAD_M, 0, 0)
            first += numbers
    if spec.speed_input:
        state[:, -1] = spec.speed
    return state


def _answers(policy: Policy, state: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the last actions (N, 3) [m/s^2] and all outputs (STEPS, N, 3), as of `probed`."""
    spec = policy.spec
    hidden, outputs, action = policy.start(len(state)), [], state[:, 9:12]
    for step in range(STEPS):
        fresh = np.full(len(state), step == 0)
        output, hidden = policy.act(hidden, state, image, fresh)
        outputs.append(output)
        action = np.asarray(spec.action.to_si(output), np.float32)
        size = np.linalg.norm(action, axis=-1, keepdims=True)
        state[:, 9:12] = action * np.minimum(1.0, 50.0 / np.maximum(size, 1e-6))
    return np.asarray(action, float), np.array(outputs, float)

"""How a policy answers small changes of a synthetic observation: level flight towards a gate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eval.effects.interface import GRAVITY
from eval.judging.guard import ActionLimits
from policies.observation import encode_depth
from policies.policy import Policy, checked_act
from policies.spec import ACTION_SIZE, EXTRAS, STATE_SIZE, PolicySpec

VEL_B, UP_B, GATE_B = slice(0, 3), slice(3, 6), slice(6, 9)
"""Parts of a state observation (`policies.observation`), in body axes: velocity, the world's z
axis, the next gate's centre."""
ASIDE_M, AHEAD_M, SPEED, STEPS = 2.0, 6.0, 3.0, 10
"""Distances of the test gate to the side and ahead [m], forward speed [m/s], number of steps."""
DRIFT, NEAR_M = 2.0, 2.0
"""Velocity to a side [m/s]; distance of an object that fills half of an image [m], or half of the
camera's range if that is less."""
SIDES = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
"""Directions left, right, up and down; columns are left and up."""


class Responses(NamedTuple):
    """Actions in SI units, and differences of actions.

    The rows of a difference (2, size) are left minus right, and up minus down.
    """

    action: np.ndarray
    """(5, size) actions for a gate to the left, to the right, above, below and straight ahead."""
    output: np.ndarray
    """(STEPS, 5, size) the outputs of all steps for these gates."""
    gate: np.ndarray
    """(2, size) difference for gates in opposite directions."""
    drift: np.ndarray
    """(2, size) difference for velocities in opposite directions."""
    near: np.ndarray
    """(2, size) difference for near objects in opposite halves of the image."""
    slow: np.ndarray
    """(size,) action at rest minus that at twice the speed."""

    @property
    def damping_s(self) -> np.ndarray:
        """Answer to a velocity [m/s] over that to a distance of the gate [m], (2,) [s].

        A positive value decelerates. It does not depend on the kind and unit of the action.
        """
        return -self._towards_gate(self.drift) * ASIDE_M / DRIFT

    @property
    def approach(self) -> np.ndarray:
        """Answer to a near object over that to a gate, (2,); a negative value avoids the object."""
        return self._towards_gate(self.near)

    def _towards_gate(self, change: np.ndarray) -> np.ndarray:
        """Return how much of `change` (2, size) is along the answer to a gate there, (2,)."""
        size = (self.gate**2).sum(-1)
        return (change * self.gate).sum(-1) / np.maximum(size, 1e-12)


def responses(policy: Policy) -> Responses:
    """Run a policy on synthetic observations and return its answers."""
    spec = policy.spec
    # Pairs of opposite changes: 4 gates, 4 velocities, 4 images, 2 speeds. Then no change.
    state = level_states(spec, np.vstack([ASIDE_M * SIDES, np.zeros((11, 2))]))
    state[4:8, 1:3] += DRIFT * SIDES
    state[12:14, 0] = 0.0, 2.0 * SPEED
    depth_m = np.full((len(state), *spec.image_shape[-2:]), spec.camera.range_m)
    height, width = (size // 2 for size in depth_m.shape[1:])
    halves = np.s_[:, :width], np.s_[:, width:], np.s_[:height], np.s_[height:]
    for row, half in enumerate(halves, start=8):
        depth_m[row][half] = min(NEAR_M, spec.camera.range_m / 2)
    image = encode_depth(spec.depth, depth_m, spec.camera.range_m).astype(np.float32)
    action, output = run(policy, state, image.reshape(len(state), *spec.image_shape))
    opposite, gates = action[:14:2] - action[1:14:2], [0, 1, 2, 3, 14]
    return Responses(
        action[gates], output[:, gates], opposite[:2], opposite[2:4], opposite[4:6], opposite[6]
    )


def level_states(spec: PolicySpec, offset: np.ndarray) -> np.ndarray:
    """Return states of level flight with a gate ahead, offset by (N, 2) to the left and up [m]."""
    state = np.zeros((len(offset), spec.state_size), np.float32)
    state[:, VEL_B], state[:, UP_B] = (SPEED, 0, 0), (0, 0, 1)
    state[:, GATE_B] = np.insert(offset, 0, AHEAD_M, axis=1)
    if spec.action.kind == "ctbr":
        state[:, last_action(spec).start] = GRAVITY  # the last thrust
    next_entry = spec.base_size
    for key, size in EXTRAS.items():
        if getattr(spec, key):
            state[:, next_entry] = spec.speed if key == "speed_input" else 1.0
            if key == "second_gate":
                state[:, next_entry : next_entry + size] = state[:, GATE_B] + (AHEAD_M, 0, 0)
            next_entry += size
    return state


def last_action(spec: PolicySpec) -> slice:
    """Return the part of a state observation that has the last action."""
    return slice(STATE_SIZE - ACTION_SIZE, spec.base_size)


def run(policy: Policy, state: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Run a policy for STEPS steps on N observations, which change in the last action only.

    Returns:
        The last actions (N, size) in SI units, and the outputs of all steps (STEPS, N, size).
    """
    spec = policy.spec
    flown = state[:, last_action(spec)]
    hidden, outputs, action = policy.start(len(state)), [], flown
    for step in range(STEPS):
        fresh = np.full(len(state), step == 0)
        output, hidden = checked_act(policy, hidden, state, image, fresh)
        outputs.append(np.asarray(output).copy())  # it may write the next one into the same array
        action = np.asarray(spec.action.to_si(output), np.float32)
        norm = np.linalg.norm(action, axis=-1, keepdims=True)
        flown[:] = action * np.minimum(1.0, ActionLimits().size / np.maximum(norm, 1e-6))
    return np.asarray(action, float), np.array(outputs, float)

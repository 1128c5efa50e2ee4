"""A policy of accelerations as one of body rates and thrust: the attitude loop is in the wrapper.

It decides at every physics step from what a policy observes, which has no heading: how far the body
has yawed since the last step is found from where a gate, which stands still, has gone.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from eval.quadrotor.attitude import action_to_force, attitude_command, blend_heading
from eval.quadrotor.autopilot import make_autopilot
from eval.vehicles.vehicle import Vehicle
from policies.policy import Policy
from policies.spec import ActionSpec
from tracks.geometry.rotation import to_world


@dataclass
class Memory:
    """Of n rows."""

    inner: Any
    """The policy's own."""
    step: np.ndarray
    decision: np.ndarray
    action_b: np.ndarray
    heading: np.ndarray
    """(n,) of the attitude loop, left of the body's own [rad]."""
    command: np.ndarray
    gates: np.ndarray
    """(n, 2, 3) the next gate and the one after it, levelled, at the last step [m]."""


class AsCtbr:
    """A `Policy` around `inner`, which sees two gates, for `vehicle`."""

    def __init__(self, inner: Policy, vehicle: Vehicle):
        assert inner.spec.second_gate
        self.inner, self.name = inner, f"{inner.name}-ctbr"
        autopilot = make_autopilot(vehicle)
        self.controller, self.dt, self.every = (
            vehicle.controller,
            autopilot.dt,
            autopilot.attitude_every,
        )
        self.spec = replace(inner.spec, rate_hz=1 / autopilot.dt, action=ActionSpec("ctbr"))

    def start(self, n):
        step, decision, heading = np.zeros((3, n))
        hover = np.tile([9.81, 0.0, 0.0, 0.0], (n, 1))
        action_b, gates = np.zeros((n, 3)), np.zeros((n, 2, 3))
        return Memory(self.inner.start(n), step, decision, action_b, heading, hover, gates)

    def act(self, hidden, state, image, fresh):
        m = hidden
        for old, new in zip(vars(m).values(), vars(self.start(len(state))).values(), strict=True):
            if old is not m.inner:
                old[fresh] = new[fresh]
        state = np.asarray(state, float)
        level = levelled(state[:, 3:6])
        gates = np.stack([to_world(level, state[:, 6:9]), to_world(level, state[:, 13:16])], 1)
        moved = to_world(level, state[:, :3]) * self.dt  # the engine moves by the new velocity
        before, after = m.gates, gates + moved[:, None]
        first = np.linalg.norm(before[:, 0], axis=-1) - np.linalg.norm(after[:, 0], axis=-1)
        switched = np.abs(first) > 1e-3
        seen = np.where(switched[:, None], after[:, 0], after[:, 1])
        turn = np.arctan2(before[:, 1, 1], before[:, 1, 0]) - np.arctan2(seen[:, 1], seen[:, 0])
        heading = np.where(m.step > 0, m.heading - turn, 0.0)
        m = replace(m, heading=heading, gates=gates)

        due = np.flatnonzero(m.step == np.rint(m.decision / (self.inner.spec.rate_hz * self.dt)))
        if len(due):
            rows = [state[due, :9], m.action_b[due], state[due, 13:]]
            inner_state = np.concatenate(rows, 1).astype(np.float32)
            action, m.inner[due] = self.inner.act(m.inner[due], inner_state, image[due], fresh[due])
            m.action_b[due] = action
            m.decision[due] += 1
        loop = m.step % self.every == 0
        heading_w = np.stack([np.cos(heading), np.sin(heading), np.zeros(len(heading))], -1)
        blended = blend_heading(heading_w, gates[:, 0], self.every * self.dt)
        command = attitude_command(
            self.controller, action_to_force(m.action_b, level), level, blended
        ).packed
        m.command = np.where(loop[:, None], command, m.command)
        m.heading = np.where(loop, np.arctan2(blended[:, 1], blended[:, 0]), heading)
        m.step = m.step + 1
        return m.command, m


def levelled(up_b: np.ndarray) -> np.ndarray:
    """Return the rotation (n, 3, 3) from the body to axes of its heading, by its third row."""
    x, y, z = up_b.T
    # Rows of empty slots are zero.
    flat = np.maximum(np.hypot(y, z), 1e-9)
    sin_roll, cos_roll, zero = y / flat, z / flat, np.zeros_like(x)
    rows = [
        [flat, -x * sin_roll, -x * cos_roll],
        [zero, cos_roll, -sin_roll],
        [x, y, z],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)

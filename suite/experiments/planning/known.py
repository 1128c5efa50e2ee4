"""A plan as a policy: the judge flies it as it flies any, by its rules, through its autopilot.

What the judge shows of the next gate, where it is and how it faces in body axes, and the world's up
say exactly where the drone is, as the plan knows where the gates are. Images it does not need.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from policies.policy import Hidden
from policies.spec import STATE_SIZE, PolicySpec
from suite.experiments.planning.flown import Ask, action, asked
from suite.experiments.planning.spline import unpacked
from tracks.geometry.camera import Camera
from tracks.geometry.rotation import cross, to_world
from tracks.geometry.scene import Gates
from tracks.track import Track

LONGEST_S = 20.0
"""Of a trial [s]."""


class Memory(NamedTuple):
    """What it remembers of one trial."""

    decisions: int
    """So far."""
    pos_w: np.ndarray
    """(3,) where it was last [m]."""


class PlannedPolicy:
    """Flies one track's plan, one trial at a time; it decides at each step of the attitude loop."""

    name = "planned"

    def __init__(self, track: Track, numbers: np.ndarray, rate_hz: float) -> None:
        """Make it from the track, its plan's numbers, and the attitude loop's frequency [Hz]."""
        self.spec = PolicySpec(rate_hz=rate_hz, camera=Camera(width=1, height=1), gate_axis=True)
        self._gates, self._start_w = track.scene.gates, track.start_pos_w
        with jax.enable_x64(True):
            time_s = np.arange(round(LONGEST_S * rate_hz) + 1) / rate_hz
            asks = asked(unpacked(np.asarray(numbers, float)), time_s)
            self._asks: Ask = jax.tree.map(np.asarray, asks)

    def start(self, n: int) -> Hidden:
        """Return the memory at the start of one trial.

        Raises:
            ValueError: for more than one, as the plan is for one.
        """
        if n != 1:
            raise ValueError(f"{n} trials at once: a plan flies one; give the judge slots=1")
        return Memory(0, self._start_w)

    def act(
        self, hidden: Hidden, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, Hidden]:
        """Return the action, as `policies.policy.Policy.act` has it."""
        del image
        count, before_w = Memory(0, self._start_w) if fresh[0] else hidden
        row = state[0].astype(float)
        pos_w, rot_w = place(self._gates, row, before_w)
        ask = jax.tree.map(lambda part: part[count], self._asks)
        action_b = action(ask, pos_w, rot_w, to_world(rot_w, row[:3]))
        return action_b[None], Memory(min(count + 1, len(self._asks.acc_w) - 1), pos_w)


def place(gates: Gates, state: np.ndarray, near_w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) and attitude (3, 3) of a drone that sees `state` of its next gate.

    Which gate that is follows from where the drone then is: near where it was.

    Args:
        gates: (G, ...) of the track.
        state: (STATE_SIZE + 3,) an observation with the gate's axis.
        near_w: (3,) where it was just before [m].
    """
    up_b, gate_b, axis_b = state[3:6], state[6:9], state[STATE_SIZE:]
    axis_w = gates.rot_w[:, :, 0]
    body = _frame(up_b, axis_b)
    world = np.stack([_frame(np.array([0.0, 0.0, 1.0]), axis) for axis in axis_w])
    rot_w = np.swapaxes(world, -1, -2) @ body
    pos_w = gates.center_w - to_world(rot_w, gate_b)
    nearest = int(((pos_w - near_w) ** 2).sum(-1).argmin())
    return pos_w[nearest], rot_w[nearest]


def _frame(up: np.ndarray, ahead: np.ndarray) -> np.ndarray:
    """Return the axes (3, 3), a row each, of a frame with z along `up` and x towards `ahead`."""
    up = up / np.linalg.norm(up)
    aside = cross(up, ahead)
    aside = aside / np.linalg.norm(aside)
    return np.stack([cross(aside, up), aside, up])

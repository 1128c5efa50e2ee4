"""The simulator `mujoco`, the default: MuJoCo's C engine simulates many trials at once."""

from __future__ import annotations

import numpy as np

from eval.quadrotor.plant import Motion, Wrench
from eval.worlds.scene_slots import TO_CONTACTS, SceneSlots
from eval.worlds.trial import is_wrench
from tracks.geometry.rotation import to_world


class MujocoWorld(SceneSlots):
    """MuJoCo moves the body by force and torque of the quadrotor model; all tables use it.

    Each step also computes the contacts at the new state, which may end the trial.
    """

    integrator = "euler"

    def _move(self, flying: np.ndarray, motion: Motion, push: Wrench) -> np.ndarray:
        """Let MuJoCo move the bodies under the force and torque `push`."""
        invalid = ~is_wrench(self._rules, push)
        moving = flying & ~invalid
        self._applied[:, :3] = to_world(motion.rot_w, push.force_b)
        self._applied[:, 3:] = push.torque_b
        self._batch.step(np.flatnonzero(moving).astype(np.int32), stage=TO_CONTACTS)
        return invalid

"""The simulator `mujoco`: many trials at once in MuJoCo's C engine (`mujoco.batch`)."""

from __future__ import annotations

import numpy as np

from eval.quadrotor.autopilot import AutopilotState, autopilot_step
from eval.quadrotor.plant import Motion, Wrench
from eval.worlds.scene_slots import TO_CONTACTS, SceneSlots
from eval.worlds.trial import is_wrench
from tracks.geometry.rotation import to_world


class MujocoWorld(SceneSlots):
    """MuJoCo's C engine, the default.

    It moves the bodies under the plant's force and torque; a step starts from the contacts.
    """

    name = "mujoco"
    integrator = "euler"

    def _control(
        self,
        motion: Motion,
        action_b: np.ndarray,
        gate_w: np.ndarray,
        step: np.ndarray,
        noise: np.ndarray | None,
    ) -> tuple[AutopilotState, Wrench]:
        return autopilot_step(self._autopilot, self._loops, motion, action_b, gate_w, step, noise)

    def _move(self, flying: np.ndarray, motion: Motion, push: Wrench) -> np.ndarray:
        bad = ~is_wrench(self._rules, push)
        go = flying & ~bad
        self._applied[:, :3] = to_world(motion.rot_w, push.force_b)
        self._applied[:, 3:] = push.torque_b
        self._batch.step(np.flatnonzero(go).astype(np.int32), stage=TO_CONTACTS)
        return bad

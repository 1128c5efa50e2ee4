"""Base class of simulators ("worlds") that find contacts with MuJoCo's C engine, in many slots.

Every slot has its own MuJoCo model, padded to a common size, and its own MjData in a
`mujoco.batch`. After each operation the contacts of the current state are up to date, so the rules
are applied before the next step.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from eval.quadrotor.autopilot import (
    AutopilotState,
    autopilot_step,
    has_new_command,
    start_autopilot,
)
from eval.quadrotor.plant import MAX_DELAY, Motion, make_plant
from eval.vehicles.vehicle import Vehicle
from eval.worlds import Rows, rows_of
from eval.worlds.engine import BODY, DepthCamera, compile_model, contact_name, start_state
from eval.worlds.slots import Slots
from eval.worlds.trial import (
    DIVERGED,
    FLYING,
    Progress,
    TrialSpec,
    has_diverged,
    judge_state,
    next_centre,
    next_gate,
    start_progress,
)
from policies.observation import View, view_of
from tracks.common.masks import make_contiguous, select, take
from tracks.formats.mujoco_scene import MESH_GROUP
from tracks.geometry.camera import Camera
from tracks.geometry.tiles import depth_images, make_tiles
from tracks.track import Track

TO_CONTACTS = int(mujoco.mjtStage.mjSTAGE_VEL)
"""Stage of the engine after which the contacts of a state are known."""
_NOTHING = int(mujoco.mjtStage.mjSTAGE_NONE)
"""Stage of the engine before any computation."""


class SceneSlots(Slots, ABC):
    """A `World` without dynamics, computed in NumPy over all slots, except for contacts.

    Subclasses define `_move` (the motion of the bodies), and may replace `_control` (what the
    autopilot gives to it).
    """

    def __init__(self, vehicle: Vehicle, camera: Camera, *arguments: Any, **settings: Any) -> None:
        """Make the world; the arguments are those of `Slots`."""
        super().__init__(vehicle, camera, *arguments, **settings)
        self._vehicles = [vehicle] * self.slots
        self._depth_camera, self._tiles = DepthCamera(camera), make_tiles(camera)
        self._progress = start_progress(np.zeros((self.slots, 3)))
        self._progress = self._progress._replace(ended=np.full(self.slots, -1, np.int32))
        self._models: list[mujoco.MjModel] = []
        self._meshes: dict[int, mujoco.MjData] = {}

    @property
    def progress(self) -> Progress:
        """Progress of the trial in each slot."""
        return self._progress

    def _build(self, model: mujoco.MjModel) -> None:
        """Make the batch of slots, all with `model` at first."""
        self._models = [model] * self.slots
        self._batch = Batch(model, self.slots, self._threads, persistent=True)
        # Views of the engine's memory: the state is written, contacts and attitude are read.
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._applied = self._batch.bind("qfrc_applied")
        self._contacts = self._batch.bind("ncon")
        self._xmat = self._batch.bind("xmat")

    def load(
        self, entries: list[tuple[int, Track, TrialSpec]], vehicles: Sequence[Vehicle] | None = None
    ) -> None:
        """Start trials from (slot, track, trial).

        There is one vehicle for each entry. They have the effects of the world's vehicle, with
        other values. If one call has vehicles, all calls must have them.
        """
        if vehicles is not None:
            self._set_vehicles([slot for slot, _, _ in entries], vehicles)
        for slot, track, _ in entries:
            model = compile_model(track, self._vehicles[slot], self.dt, self._layout.solids)
            if not self._models:
                self._build(model)
            self._models[slot] = model
            if track.mesh_sizes:  # meshes do not move, so one computation suffices for all images
                self._meshes[slot] = mujoco.MjData(model)
                mujoco.mj_kinematics(model, self._meshes[slot])
        ids = np.array([slot for slot, _, _ in entries], np.int32)
        started = self._insert(entries, meshes=False)  # MuJoCo casts the rays on meshes
        self._batch.set_models(self._models)
        self._batch.reset(ids, stage=_NOTHING)
        for slot, track, _ in entries:
            self._qpos[slot], self._qvel[slot] = start_state(track), 0.0
        self._batch.forward(ids, stage=TO_CONTACTS)

        motion = self._motion()
        noise = self._draws_at(np.where(started, 0, self._progress.step + 1))
        initial = start_autopilot(self._autopilot, motion, noise)
        self._loops = make_contiguous(select(started, initial, getattr(self, "_loops", initial)))
        self._progress = select(started, start_progress(motion.pos_w), self._progress)
        self._judge(started, np.zeros(self.slots, bool))

    def _set_vehicles(self, slots: list[int], vehicles: Sequence[Vehicle]) -> None:
        """Assign a vehicle to each of `slots`, and stack the values of all vehicles' effects."""
        for slot, vehicle in zip(slots, vehicles, strict=True):
            self._vehicles[slot] = vehicle
        values = {}
        for name, values_of_first in self._vehicles[0].effects.items():
            rows = zip(*(vehicle.effects[name] for vehicle in self._vehicles), strict=True)
            values[name] = type(values_of_first)(
                *(np.stack([np.asarray(x) for x in row]) for row in rows)
            )
        plant = make_plant(self._vehicles[0], self.dt, values, MAX_DELAY)
        self._autopilot = replace(self._autopilot, plant=plant)

    def _motion(self) -> Motion:
        rot_w = self._xmat[:, BODY].reshape(self.slots, 3, 3).copy()
        velocity = self._qvel.copy()
        return Motion(self._qpos[:, :3].copy(), rot_w, velocity[:, :3], velocity[:, 3:])

    def _judge(self, selected: np.ndarray, invalid: np.ndarray) -> None:
        """Apply the rules to the current states of the `selected` slots (N,) bool.

        `invalid` (N,) bool are the slots in which no step was possible.
        """
        motion, contact = self._motion(), self._contacts > 0
        diverged = invalid | has_diverged(self._rules, motion)
        with np.errstate(invalid="ignore", over="ignore"):  # in slots that have diverged
            judged = judge_state(
                self._rules, self._progress, self._course, self.dt, motion, contact, diverged
            )
        self._progress = select(selected, judged, self._progress)

    def collided_with(self, slot: int) -> str:
        """Return the name of the solid that the trial in `slot` collided with."""
        return contact_name(self._models[slot], self._batch.get_data(slot))

    def view(self, wanted: np.ndarray) -> View:
        """Return the current view; images only for the slots in `wanted` (N,) bool."""
        motion = self._motion()
        camera, slots = self._camera, np.flatnonzero(wanted)
        depth = np.full((self.slots, camera.height, camera.width), camera.range_m)
        if len(slots):
            depth[slots] = self._images(slots, *take(motion[:2], slots))
        gate = next_gate(self._course, self._progress.gates)
        second_gate = next_gate(self._course, self._progress.gates + 1)
        return view_of(motion.pos_w, motion.rot_w, motion.vel_w, gate, second_gate, depth)

    def _images(self, slots: np.ndarray, pos_w: np.ndarray, rot_w: np.ndarray) -> np.ndarray:
        """Return the depth images of `slots` (K,) from pos_w (K, 3) and rot_w (K, 3, 3)."""
        depth = depth_images(self._tiles, take(self._scene, slots), pos_w, rot_w)
        for row, slot in enumerate(slots.tolist()):
            if slot in self._meshes:
                model, data = self._models[slot], self._meshes[slot]
                meshes = self._depth_camera.image(model, data, pos_w[row], rot_w[row], MESH_GROUP)
                depth[row] = np.minimum(depth[row], meshes)
        return depth

    def _control(
        self,
        motion: Motion,
        action_b: np.ndarray,
        gate_w: np.ndarray,
        step: np.ndarray,
        noise: np.ndarray | None,
    ) -> tuple[AutopilotState, Any]:
        """Return the autopilot's state after a physics step, and its output for `_move`.

        The arguments are those of `eval.quadrotor.autopilot.autopilot_step`, for all slots, and
        the output is its force and torque on the body. The state has contiguous arrays; see
        `make_contiguous`.
        """
        return autopilot_step(self._autopilot, self._loops, motion, action_b, gate_w, step, noise)

    @abstractmethod
    def _move(self, flying: np.ndarray, motion: Motion, push: Any) -> np.ndarray:
        """Simulate one physics step in the slots `flying` (N,) bool.

        `motion` (N, ...) are states before the step, `push` is the output of `_control`.

        Returns:
            The slots in which no step is possible, (N,) bool; they keep their state.
        """

    def advance(self, action_b: np.ndarray, steps: np.ndarray, record: bool) -> list[Rows]:
        """Fly each slot's action (N, size) for its number of physics steps (N,)."""
        rows = []
        for done in range(int(steps.max(initial=0))):
            flying = (steps > done) & (self._progress.ended == FLYING)
            if not flying.any():
                break
            step, motion = self._progress.step, self._motion()
            gate_w = next_centre(self._course, self._progress.gates)
            rotor_speed = self._loops.plant.rotor_speed
            draws = self._draws_at(step + 1)
            loops, push = self._control(motion, action_b, gate_w, step, draws)
            before, self._loops = self._loops, select(flying, loops, self._loops)
            if record:
                due = flying & has_new_command(self._autopilot, before, loops, step)
                rows += self._rows(due, rotor_speed)
            invalid = self._move(flying, motion, push)
            self._progress = self._progress._replace(step=step + flying)
            self._judge(flying, invalid)
            if record:
                ended = ~np.isin(self._progress.ended, (FLYING, DIVERGED))
                rows += self._rows(flying & ended, self._loops.plant.rotor_speed)
            diverged = np.flatnonzero(flying & (self._progress.ended == DIVERGED))
            if len(diverged):  # their invalid numbers must not enter later computations
                self._batch.reset(diverged.astype(np.int32), stage=TO_CONTACTS)
        return rows

    def _rows(self, due: np.ndarray, rotor_speed: np.ndarray) -> list[Rows]:
        """Return the rows of the flight logs at this step; [] if no slot is `due` (N,) bool."""
        if not due.any():
            return []
        joint, command = (self._qpos.copy(), self._qvel.copy()), self._loops.command
        return [rows_of(due, self._progress, self.dt, *joint, command, rotor_speed)]

"""The simulator `mjx`: many trials (flights along a track) at once in JAX, for accelerators.

MuJoCo's JAX engine moves the free body. Its contacts are disabled: they take ten times the time of
all other computations, and a trial ends at the first contact anyway. Collisions are found by signed
distances instead, and depth images by analytic ray casting. The steps between two decisions of the
policy are one compiled function. States are float32, so a flight departs slowly from the same
flight in `mujoco`. A trial's outcome does not depend on the other trials, but another number of
slots changes the last bits.
"""

from __future__ import annotations

import contextlib
import functools
import io
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from eval.quadrotor.autopilot import (
    AutopilotState,
    autopilot_step,
    has_new_command,
    start_autopilot,
)
from eval.quadrotor.model import compile_quadrotor
from eval.quadrotor.plant import Motion
from eval.vehicles.vehicle import Vehicle
from eval.worlds import Rows, rows_of
from eval.worlds.collision import NEAR_STEPS, box_distances, near_solids
from eval.worlds.engine import start_state
from eval.worlds.slots import Layout, Slots
from eval.worlds.trial import (
    DIVERGED,
    FLYING,
    Course,
    Progress,
    TrialSpec,
    has_diverged,
    is_wrench,
    judge_state,
    next_centre,
    next_gate,
    start_progress,
)
from policies.observation import View, view_of
from tracks.common.masks import select, take
from tracks.formats.mujoco_scene import GROUND
from tracks.geometry.camera import Camera, cast_rays_b, nearest
from tracks.geometry.depth import depth_image
from tracks.geometry.rotation import quat_to_rot, to_world
from tracks.geometry.scene import Array, Scene, counts
from tracks.track import Track

with contextlib.redirect_stdout(io.StringIO()):  # the import prints a list of missing packages
    from mujoco import mjx


PRECISION = "highest"
"""Precision of matrix products; the default of accelerators is too low for rotations."""
FARTHEST_M = 1000.0
"""Largest allowed coordinate [m]. There, the resolution of a float32 is 0.06 mm."""


class SlotStates(NamedTuple):
    """The state of all N slots, on the accelerator."""

    qpos: Array
    """(N, 7) position [m] and quaternion wxyz."""
    qvel: Array
    """(N, 6) velocity in the world [m/s] and body rates [rad/s]."""
    loops: AutopilotState
    """State of the autopilot."""
    progress: Progress
    """Progress of the trials."""


class MjxWorld(Slots):
    """The same model for many drones in one compiled JAX program, for GPUs."""

    integrator = "euler"
    compiles = True
    dtype = np.float32

    def __init__(self, vehicle: Vehicle, camera: Camera, *arguments: Any, **settings: Any) -> None:
        """Make the world; the arguments are those of `MujocoWorld`, but `threads` has no effect."""
        super().__init__(vehicle, camera, *arguments, **settings)
        free = mujoco.MjSpec()
        free.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self._model = mjx.put_model(compile_quadrotor(free, vehicle, self.dt))
        self._half_size = np.asarray(vehicle.body.half_size)
        self._middle_b = -np.asarray(self._autopilot.plant.constants.com_offset_b)
        self._rays_b = jnp.asarray(cast_rays_b(camera), jnp.float32)
        self._max_steps = 0
        self._tracks: list[Track | None] = [None] * self.slots
        self._on_device: tuple[Course, Scene] | None = None
        self._state = self._idle()

    @functools.partial(jax.jit, static_argnums=0)  # one program instead of one for each operation
    def _idle(self) -> SlotStates:
        """Return the states of slots before their first trial."""
        zeros = jnp.zeros((self.slots, 3))
        motion = Motion(zeros, jnp.tile(jnp.eye(3), (self.slots, 1, 1)), zeros, zeros)
        progress = start_progress(motion.pos_w)
        progress = progress._replace(ended=jnp.full(self.slots, -1, jnp.int32))
        qpos = jnp.tile(jnp.asarray([0.0, 0, 0, 1, 0, 0, 0]), (self.slots, 1))
        loops = start_autopilot(self._autopilot, motion, self._draws_at(np.zeros(self.slots, int)))
        return SlotStates(qpos, jnp.zeros((self.slots, 6)), loops, progress)

    @property
    def progress(self) -> Progress:
        """Progress of the trial in each slot."""
        return jax.tree.map(np.asarray, self._state.progress)

    def load(self, entries: list[tuple[int, Track, TrialSpec]]) -> None:
        """Start trials from (slot, track, trial).

        Raises:
            ValueError: for a track so far from the origin that float32 is too coarse.
        """
        for _, track, _ in entries:
            _check_near(track)
        started, qpos = self._insert(entries, meshes=True), np.array(self._state.qpos)
        for slot, track, _ in entries:
            self._tracks[slot], qpos[slot] = track, start_state(track)
        noise = self._draws_at(np.where(started, 0, np.asarray(self._state.progress.step) + 1))
        # Copies, because on a CPU JAX may share memory with the arrays that it gets.
        on_device = jax.tree.map(lambda a: jnp.array(a), (self._course, self._scene))
        self._on_device = on_device
        with jax.default_matmul_precision(PRECISION):
            self._state = self._start(
                self._state, jnp.array(qpos), jnp.array(started), noise, *on_device
            )

    @functools.partial(jax.jit, static_argnums=0)
    def _start(
        self,
        state: SlotStates,
        qpos: Array,
        started: Array,
        noise: Array | None,
        course: Course,
        scene: Scene,
    ) -> SlotStates:
        """Return the states with new trials at `qpos` in the slots `started` (N,) bool."""
        motion = _motion(qpos, jnp.zeros_like(state.qvel))
        loops = start_autopilot(self._autopilot, motion, noise)
        initial = SlotStates(qpos, jnp.zeros_like(state.qvel), loops, start_progress(motion.pos_w))
        state = select(started, initial, state)
        near = near_solids(scene, motion.pos_w)
        return self._judge(state, started, jnp.zeros_like(started), course, near)

    def _judge(
        self, state: SlotStates, selected: Array, invalid: Array, course: Course, near: Scene
    ) -> SlotStates:
        """Apply the rules to the `selected` slots (N,) bool; diverged slots are reset to rest.

        In `invalid` slots (N,) bool no step was possible. `near` are the solids nearest to each
        drone.
        """
        motion = _motion(state.qpos, state.qvel)
        diverged = invalid | has_diverged(self._rules, motion)
        pos_w, rot_w, _, _ = motion
        distance = box_distances(near, pos_w, rot_w, self._half_size, self._middle_b)
        contact = (distance <= 0.0).any(-1)
        progress = judge_state(
            self._rules, state.progress, course, self.dt, motion, contact, diverged
        )
        progress = select(selected, progress, state.progress)
        reset = (progress.ended == DIVERGED)[:, None]
        rest = jnp.asarray([0.0, 0, 0, 1, 0, 0, 0])
        qpos = jnp.where(reset, rest, state.qpos)
        qvel = jnp.where(reset, 0.0, state.qvel)
        judged = SlotStates(qpos, qvel, state.loops, progress)
        # `astype` removes weak types, with which the next call would compile again.
        return jax.tree.map(lambda a: a.astype(a.dtype), judged)

    def collided_with(self, slot: int) -> str:
        """Return the name of the solid that the trial in `slot` collided with."""
        track, scene = self._tracks[slot], take(self._scene, [slot])
        assert track is not None
        qpos, qvel = np.asarray(self._state.qpos)[[slot]], np.asarray(self._state.qvel)[[slot]]
        distance = _distances_at(scene, qpos, qvel, self._half_size, self._middle_b)
        return _solid_names(track, self._layout)[int(np.asarray(distance)[0].argmin())]

    def view(self, wanted: np.ndarray) -> View:
        """Return the current view, with images for all slots if any are wanted."""
        assert self._on_device is not None
        course, scene = self._on_device
        with jax.default_matmul_precision(PRECISION):
            view = self._view(self._state, course, scene, bool(wanted.any()))
        return jax.tree.map(lambda field: np.asarray(field, np.float64), view)

    @functools.partial(jax.jit, static_argnums=(0, 4))
    def _view(self, state: SlotStates, course: Course, scene: Scene, images: bool) -> View:
        """Return the current view of all slots; without `images` these show nothing in range."""
        pos_w, rot_w, vel_w, _ = _motion(state.qpos, state.qvel)
        camera = self._camera
        if images:
            depth = depth_image(scene, pos_w, rot_w, self._rays_b, camera.range_m)
            depth_m = nearest(camera, depth)
        else:
            depth_m = jnp.full((len(pos_w), camera.height, camera.width), camera.range_m)
        gate = next_gate(course, state.progress.gates)
        second_gate = next_gate(course, state.progress.gates + 1)
        return view_of(pos_w, rot_w, vel_w, gate, second_gate, depth_m)

    def advance(self, action_b: np.ndarray, steps: np.ndarray, record: bool) -> list[Rows]:
        """Fly each slot's action (N, size) for its number of physics steps (N,)."""
        assert self._on_device is not None
        # Periods between decisions differ by one step. With the longest period for all calls, the
        # program is compiled only once.
        self._max_steps = max_steps = max(self._max_steps, int(steps.max(initial=0)))
        noise = self._draws(np.asarray(self._state.progress.step) + 1, max_steps)
        with jax.default_matmul_precision(PRECISION):
            self._state, rows = self._fly(
                self._state, jnp.asarray(action_b, jnp.float32), jnp.asarray(steps), noise,
                *self._on_device, max_steps, record,
            )  # fmt: skip
        if not record:
            return []
        # `rows` holds rows before commands, and rows at the ends of trials; each field is
        # (max_steps, N, ...).
        row_sets = [jax.tree.map(np.asarray, row_set) for row_set in rows]
        return [
            Rows(*(field[k] for field in row_set)) for k in range(max_steps) for row_set in row_sets
            if row_set.due[k].any()
        ]  # fmt: skip

    @functools.partial(jax.jit, static_argnums=(0, 7, 8))
    def _fly(
        self,
        state: SlotStates,
        action_b: Array,
        steps: Array,
        noise: Array | None,
        course: Course,
        scene: Scene,
        max_steps: int,
        record: bool,
    ) -> tuple[SlotStates, tuple[Rows, Rows] | None]:
        """Simulate `steps` (N,) physics steps, and return the states and the recorded rows.

        The rows are those before a new command, and those at the end of a trial.
        """
        near = near_solids(scene, state.qpos[:, :3])

        def physics_step(
            carry: tuple[SlotStates, Scene], inputs: tuple[Array, Array | None]
        ) -> tuple[tuple[SlotStates, Scene], Any]:
            (state, near), (done, draws) = carry, inputs
            near = jax.lax.cond(
                (done > 0) & (done % NEAR_STEPS == 0),
                lambda: near_solids(scene, state.qpos[:, :3]),
                lambda: near,
            )
            flying = (steps > done) & (state.progress.ended == FLYING)
            motion, step = _motion(state.qpos, state.qvel), state.progress.step
            gate_w = next_centre(course, state.progress.gates)
            loops, wrench = autopilot_step(
                self._autopilot, state.loops, motion, action_b, gate_w, step, draws
            )
            loops = select(flying, loops, state.loops)
            invalid = ~is_wrench(self._rules, wrench)
            force_w = to_world(motion.rot_w, wrench.force_b)
            applied = jnp.concatenate([force_w, wrench.torque_b], axis=-1)
            qpos, qvel = self._integrate(state.qpos, state.qvel, applied)
            moving = (flying & ~invalid)[:, None]
            moved = SlotStates(
                jnp.where(moving, qpos, state.qpos),
                jnp.where(moving, qvel, state.qvel),
                loops,
                state.progress._replace(step=step + flying.astype(jnp.int32)),
            )
            after = self._judge(moved, flying, invalid, course, near)
            if not record:
                return (after, near), None
            before = state._replace(loops=loops)
            due = flying & has_new_command(self._autopilot, state.loops, loops, step)
            ended = flying & (after.progress.ended != FLYING) & (after.progress.ended != DIVERGED)
            return (after, near), (
                self._rows(due, before, state.loops.plant.rotor_speed),
                self._rows(ended, after, loops.plant.rotor_speed),
            )

        steps_and_noise = jnp.arange(max_steps), noise
        (state, _), rows = jax.lax.scan(physics_step, (state, near), steps_and_noise)
        return state, rows

    def _integrate(self, qpos: Array, qvel: Array, applied: Array) -> tuple[Array, Array]:
        """Return qpos and qvel after one step of the free bodies, under forces `applied` (N, 6)."""
        initial = mjx.make_data(self._model)

        def step_body(qpos: Array, qvel: Array, applied: Array) -> tuple[Array, Array]:
            data = initial.replace(qpos=qpos, qvel=qvel, qfrc_applied=applied)
            data = mjx.step(self._model, data)
            return data.qpos, data.qvel

        return jax.vmap(step_body)(qpos, qvel, applied)

    def _rows(self, due: Array, state: SlotStates, rotor_speed: Array) -> Rows:
        """Return the rows of the flight logs, for the slots in `due` (N,) bool."""
        qpos, qvel, loops, progress = state
        return rows_of(due, progress, self.dt, qpos, qvel, loops.command, rotor_speed)


@jax.jit
def _distances_at(
    scene: Scene, qpos: Array, qvel: Array, half_size: Array, middle_b: Array
) -> Array:
    """Return `box_distances` of free joints (N, 7) and (N, 6)."""
    pos_w, rot_w, _, _ = _motion(qpos, qvel)
    return box_distances(scene, pos_w, rot_w, half_size, middle_b)


def _check_near(track: Track) -> None:
    """Reject a track with a coordinate beyond `FARTHEST_M`."""
    points_w = np.vstack([track.scene.gates.center_w, np.reshape(track.start_pos_w, (1, 3))])
    farthest = float(np.abs(points_w).max())
    if farthest > FARTHEST_M:
        raise ValueError(
            f"track {track.family!r} reaches {farthest:.0f} m from the origin; world 'mjx' has "
            f"single precision and allows {FARTHEST_M:.0f} m: move the track nearer, or fly in "
            "'mujoco'"
        )


def _motion(qpos: Array, qvel: Array) -> Motion:
    """Return the motion (N, ...) of free joints, with normalised quaternions."""
    quat_wxyz = qpos[:, 3:]
    rot_w = quat_to_rot(quat_wxyz / jnp.sqrt((quat_wxyz * quat_wxyz).sum(-1, keepdims=True)))
    return Motion(qpos[:, :3], rot_w, qvel[:, :3], qvel[:, 3:])


def _solid_names(track: Track, layout: Layout) -> list[str]:
    """Return a name for every column of `box_distances` on the padded scene."""
    names, remaining, present = [], list(track.names), counts(track.scene)
    for count, padded_count in zip(present[:4], layout.solids, strict=False):
        names += remaining[:count] + ["parked"] * (padded_count - count)
        remaining = remaining[count:]
    for mesh, size in zip(remaining, track.mesh_sizes, strict=True):
        names += [mesh] * size
    names += ["parked"] * (layout.solids.triangles - present.triangles)
    return [*names, GROUND]

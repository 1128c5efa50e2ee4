"""The simulator `mjx`: many trials at once in JAX, for accelerators.

MuJoCo's JAX engine moves the free body; its contacts are off, since they cost ten times as much as
all else and a trial ends at the first of them: collisions are found by signed distance, images by
analytic rays. Everything between two decisions of the policy is one compiled function. States are
float32, so a flight drifts from the `mujoco` world's; a trial's outcome still depends on nothing
but the trial.
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

from eval.quadrotor.autopilot import AutopilotState, autopilot_step, make_autopilot, start_autopilot
from eval.quadrotor.model import compile_quadrotor
from eval.quadrotor.plant import Motion, uses_noise
from eval.vehicles.vehicle import Vehicle
from eval.worlds import Rows
from eval.worlds.collision import NEAR_STEPS, box_distances, near_solids
from eval.worlds.engine import start_state
from eval.worlds.slots import IDLE, Gusts, Layout, empty_course, pad_gates
from eval.worlds.trial import (
    DIVERGED,
    FLYING,
    Course,
    Progress,
    Rules,
    TrialSpec,
    has_diverged,
    is_wrench,
    judge_state,
    next_centre,
    next_gate,
    start_progress,
)
from policies.observation import View, view_of
from policies.spec import ActionSpec
from tracks.common.masks import select
from tracks.formats.mujoco_scene import GROUND
from tracks.geometry.camera import Camera, cast_rays_b, nearest
from tracks.geometry.depth import depth_image
from tracks.geometry.rotation import quat_to_rot, to_world
from tracks.geometry.scene import Array, Scene, pad, stack
from tracks.track import Track

with contextlib.redirect_stdout(io.StringIO()):  # its import prints what optional parts are missing
    from mujoco import mjx


PRECISION = "highest"
"""Precision of matrix products: by default accelerators round to fewer bits, too few for
rotations."""
FARTHEST_M = 1000.0
"""Largest coordinate, at which a float32's resolution is 0.06 mm [m]."""


class Flying(NamedTuple):
    """The state of all slots on the device."""

    qpos: Array
    """(N, 7)."""
    qvel: Array
    """(N, 6)."""
    loops: AutopilotState
    progress: Progress


class MjxWorld:
    """MuJoCo in JAX, for GPUs: all slots in one compiled program."""

    name = "mjx"
    integrator = "euler"
    compiles = True
    actions = ("ctbr", "motors")

    def __init__(
        self,
        vehicle: Vehicle,
        camera: Camera,
        layout: Layout,
        rules: Rules,
        slots: int,
        threads: int = 1,
        action: ActionSpec | None = None,
    ) -> None:
        """Make the world; the arguments are those of `MujocoWorld`, but JAX sets the threads."""
        self.slots = slots
        self._layout, self._rules, self._camera = layout, rules, camera
        self._autopilot = make_autopilot(vehicle, action)
        self.dt = self._autopilot.dt
        free = mujoco.MjSpec()
        free.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self._model = mjx.put_model(compile_quadrotor(free, vehicle, self.dt))
        self._half_size = np.asarray(vehicle.body.half_size)
        self._middle_b = -np.asarray(self._autopilot.plant.constants.com_offset_b)
        self._rays_b = jnp.asarray(cast_rays_b(camera), jnp.float32)
        self._most = 0
        self._has_noise = uses_noise(self._autopilot.plant)
        self._noise = [Gusts(IDLE)] * slots
        self._course = empty_course(slots, layout)
        self._tracks: list[Track | None] = [None] * slots
        self._scene: Scene | None = None
        self._on_device: tuple[Course, Scene] | None = None
        self._state = self._idle()

    @functools.partial(jax.jit, static_argnums=0)  # one program instead of one an operation
    def _idle(self) -> Flying:
        still = jnp.zeros((self.slots, 3))
        nothing = Motion(still, jnp.tile(jnp.eye(3), (self.slots, 1, 1)), still, still)
        progress = start_progress(nothing.pos_w)
        progress = progress._replace(ended=jnp.full(self.slots, -1, jnp.int32))
        qpos = jnp.tile(jnp.asarray([0.0, 0, 0, 1, 0, 0, 0]), (self.slots, 1))
        loops = start_autopilot(self._autopilot, nothing, self._no_draws())
        return Flying(qpos, jnp.zeros((self.slots, 6)), loops, progress)

    @property
    def progress(self) -> Progress:
        """Progress of the trial in each slot."""
        return jax.tree.map(np.asarray, self._state.progress)

    def _no_draws(self) -> np.ndarray | None:
        return np.zeros((self.slots, 3), np.float32) if self._has_noise else None

    def load(self, entries: list[tuple[int, Track, TrialSpec]]) -> None:
        """Start trials from (slot, track, trial).

        Raises:
            ValueError: for a track so far from the origin that float32 does not tell its steps.
        """
        for _, track, _ in entries:
            _check_near(track)
        started, noise = np.zeros(self.slots, bool), self._no_draws()
        qpos = np.array(self._state.qpos)
        for slot, track, trial in entries:
            started[slot], self._tracks[slot] = True, track
            gates = pad_gates(track.scene.gates, self._layout.gates, self._layout.corners)
            one = stack([track.scene._replace(gates=gates)], self._layout.solids)
            if self._scene is None:
                self._scene = jax.tree.map(lambda a: np.repeat(a, self.slots, axis=0), one)
            for every, new in zip(jax.tree.leaves(self._scene), jax.tree.leaves(one), strict=True):
                every[slot] = new[0]
            for field, value in zip(self._course.gates, gates, strict=True):
                field[slot] = value
            self._course.count[slot] = len(track.scene.gates.center_w)
            qpos[slot] = start_state(track)
            if noise is not None:
                self._noise[slot] = Gusts(trial)
                noise[slot] = self._noise[slot].at(0, 1)[0]
        # A copy: on a CPU JAX may go on looking at the array it is given.
        on_device = jax.tree.map(lambda a: jnp.array(a), (self._course, self._scene))
        self._on_device = on_device
        with jax.default_matmul_precision(PRECISION):
            self._state = self._start(
                self._state, jnp.array(qpos), jnp.array(started), noise, *on_device
            )

    @functools.partial(jax.jit, static_argnums=0)
    def _start(
        self,
        state: Flying,
        qpos: Array,
        started: Array,
        noise: Array | None,
        course: Course,
        scene: Scene,
    ) -> Flying:
        motion = _motion(qpos, jnp.zeros_like(state.qvel))
        loops = start_autopilot(self._autopilot, motion, noise)
        fresh = Flying(qpos, jnp.zeros_like(state.qvel), loops, start_progress(motion.pos_w))
        state = select(started, fresh, state)
        near = near_solids(scene, motion.pos_w)
        return self._judge(state, started, jnp.zeros_like(started), course, near)

    def _judge(
        self, state: Flying, which: Array, bad: Array, course: Course, near: Scene
    ) -> Flying:
        """Judge the current states of the slots in `which`; diverged ones are reset to rest."""
        motion = _motion(state.qpos, state.qvel)
        diverged = bad | has_diverged(self._rules, motion)
        pos_w, rot_w, _, _ = motion
        distance = box_distances(near, pos_w, rot_w, self._half_size, self._middle_b)
        contact = (distance <= 0.0).any(-1)
        verdict = judge_state(
            self._rules, state.progress, course, self.dt, motion, contact, diverged
        )
        progress = select(which, verdict, state.progress)
        lost = progress.ended == DIVERGED
        rest = jnp.asarray([0.0, 0, 0, 1, 0, 0, 0])
        qpos = jnp.where(lost[:, None], rest, state.qpos)
        qvel = jnp.where(lost[:, None], 0.0, state.qvel)
        judged = Flying(qpos, qvel, state.loops, progress)
        # Types of their own: one that Python's numbers gave would compile everything twice.
        return jax.tree.map(lambda a: a.astype(a.dtype), judged)

    def collided_with(self, slot: int) -> str:
        """Return the name of the solid that the trial in `slot` collided with."""
        track = self._tracks[slot]
        assert track is not None
        gates = pad_gates(track.scene.gates, self._layout.gates, self._layout.corners)
        scene = pad(track.scene._replace(gates=gates), self._layout.solids)
        scene = jax.tree.map(lambda a: jnp.asarray(a[None], jnp.float32), scene)
        pos_w, rot_w, _, _ = _motion(self._state.qpos[slot][None], self._state.qvel[slot][None])
        distance = _box_distances(scene, pos_w, rot_w, self._half_size, self._middle_b)
        return _solid_names(track, self._layout)[int(np.asarray(distance)[0].argmin())]

    def view(self, wanted: np.ndarray) -> View:
        """Return the current view."""
        assert self._on_device is not None
        course, scene = self._on_device
        with jax.default_matmul_precision(PRECISION):
            seen = self._view(self._state, course, scene)
        return View(*(np.asarray(part, np.float64) for part in seen))

    @functools.partial(jax.jit, static_argnums=0)
    def _view(self, state: Flying, course: Course, scene: Scene) -> View:
        pos_w, rot_w, vel_w, _ = _motion(state.qpos, state.qvel)
        depth = depth_image(scene, pos_w, rot_w, self._rays_b, self._camera.range_m)
        gate, after = (next_gate(course, state.progress.gates + ahead) for ahead in (0, 1))
        return view_of(pos_w, rot_w, vel_w, gate, after, nearest(self._camera, depth))

    def advance(self, action_b: np.ndarray, steps: np.ndarray, record: bool) -> list[Rows]:
        """Fly each slot's action (N, size) for its number of physics steps (N,)."""
        assert self._on_device is not None
        # Decisions are a step more or less apart; one length means one compiled program.
        self._most = most = max(self._most, int(steps.max(initial=0)))
        noise = None
        if self._has_noise:
            first = np.asarray(self._state.progress.step) + 1
            pairs = zip(first.tolist(), self._noise, strict=True)
            noise = np.stack([draws.at(step, most) for step, draws in pairs], axis=1)
            noise = noise.astype(np.float32)
        with jax.default_matmul_precision(PRECISION):
            self._state, rows = self._fly(
                self._state, jnp.asarray(action_b, jnp.float32), jnp.asarray(steps), noise,
                *self._on_device, most, record,
            )  # fmt: skip
        if not record:
            return []
        each = [jax.tree.map(np.asarray, part) for part in rows]
        return [
            Rows(*(field[k] for field in part)) for k in range(most) for part in each
            if part.due[k].any()
        ]  # fmt: skip

    @functools.partial(jax.jit, static_argnums=(0, 7, 8))
    def _fly(
        self,
        state: Flying,
        action_b: Array,
        steps: Array,
        noise: Array | None,
        course: Course,
        scene: Scene,
        most: int,
        record: bool,
    ) -> tuple[Flying, tuple[Rows, Rows] | None]:
        near = near_solids(scene, state.qpos[:, :3])

        def one(
            carry: tuple[Flying, Scene], inputs: tuple[Array, Array | None]
        ) -> tuple[tuple[Flying, Scene], Any]:
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
            bad = ~is_wrench(self._rules, wrench)
            force_w = to_world(motion.rot_w, wrench.force_b)
            applied = jnp.concatenate([force_w, wrench.torque_b], axis=-1)
            qpos, qvel = self._integrate(state.qpos, state.qvel, applied)
            go = flying & ~bad
            moved = Flying(
                jnp.where(go[:, None], qpos, state.qpos),
                jnp.where(go[:, None], qvel, state.qvel),
                loops,
                state.progress._replace(step=step + flying.astype(jnp.int32)),
            )
            after = self._judge(moved, flying, bad, course, near)
            if not record:
                return (after, near), None
            before = state._replace(loops=loops)
            due = flying & (step % self._autopilot.attitude_every == 0)
            ended = flying & (after.progress.ended != FLYING) & (after.progress.ended != DIVERGED)
            return (after, near), (
                self._rows(due, before, state.loops.plant.rotor_speed),
                self._rows(ended, after, loops.plant.rotor_speed),
            )

        (state, _), rows = jax.lax.scan(one, (state, near), (jnp.arange(most), noise))
        return state, rows

    def _integrate(self, qpos: Array, qvel: Array, applied: Array) -> tuple[Array, Array]:
        """Return the state after one step of the free body."""
        still = mjx.make_data(self._model)

        def one(qpos: Array, qvel: Array, applied: Array) -> tuple[Array, Array]:
            data = still.replace(qpos=qpos, qvel=qvel, qfrc_applied=applied)
            data = mjx.step(self._model, data)
            return data.qpos, data.qvel

        return jax.vmap(one)(qpos, qvel, applied)

    def _rows(self, due: Array, state: Flying, rotor_speed: Array) -> Rows:
        command = state.loops.command
        return Rows(
            due, state.progress.step * self.dt, state.qpos[:, :3], state.qpos[:, 3:],
            state.qvel[:, :3], state.qvel[:, 3:], command.thrust, command.rate_b, rotor_speed,
            state.progress.gates,
        )  # fmt: skip


_box_distances = jax.jit(box_distances)


def _check_near(track: Track) -> None:
    places_w = np.vstack([track.scene.gates.center_w, np.reshape(track.start_pos_w, (1, 3))])
    farthest = float(np.abs(places_w).max())
    if farthest > FARTHEST_M:
        raise ValueError(
            f"track {track.family!r} reaches {farthest:.0f} m from the origin; world 'mjx' is of "
            f"single precision and flies up to {FARTHEST_M:.0f} m: move the track nearer, or fly "
            "in 'mujoco'"
        )


def _motion(qpos: Array, qvel: Array) -> Motion:
    """Return the motion (N, ...) of free joints; the quaternion is normalised on the way."""
    quat = qpos[:, 3:]
    rot_w = quat_to_rot(quat / jnp.sqrt((quat * quat).sum(-1, keepdims=True)))
    return Motion(qpos[:, :3], rot_w, qvel[:, :3], qvel[:, 3:])


def _solid_names(track: Track, layout: Layout) -> list[str]:
    """Return a name for every column of `box_distances` on the padded scene."""
    names, left = [], list(track.names)
    scene = track.scene
    kinds = (scene.boxes, scene.cylinders, scene.capsules, scene.spheres)
    for kind, room in zip(kinds, layout.solids, strict=False):
        real = len(kind[0])
        names += left[:real] + ["parked"] * (room - real)
        left = left[real:]
    for mesh, size in zip(left, track.mesh_sizes, strict=True):
        names += [mesh] * size
    names += ["parked"] * (layout.solids.triangles - len(scene.triangles))
    return [*names, GROUND]

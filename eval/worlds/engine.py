"""Parts that the simulators on MuJoCo's C engine share: models, depth images and contacts."""

from __future__ import annotations

import warnings
from collections.abc import Iterable

import mujoco
import numpy as np

from eval.quadrotor.model import compile_quadrotor
from eval.quadrotor.plant import Motion, Wrench
from eval.vehicles.vehicle import Vehicle
from eval.worlds.slots import layout_of
from eval.worlds.trial import (
    Course,
    Progress,
    Rules,
    has_diverged,
    is_wrench,
    judge_state,
    start_progress,
)
from tracks.families import FAMILIES, make_track
from tracks.formats.mujoco_scene import add_scene, solid_name
from tracks.formats.plausibility import track_notes
from tracks.geometry.camera import Camera, cast_rays_b, nearest
from tracks.geometry.rotation import to_world
from tracks.geometry.scene import Counts, Gates, counts
from tracks.track import Track
from tracks.track_check import check_track

BODY = 1
"""Index of the quadrotor's body in a model; the world body has index 0."""
NO_AUTORESET = mujoco.mjtDisableBit.mjDSBL_AUTORESET
"""Flag that disables MuJoCo's reset of invalid states, so that a trial can end as diverged."""


def compile_model(track: Track, vehicle: Vehicle, dt: float, padded: Counts) -> mujoco.MjModel:
    """Return the model of a vehicle on a track, padded so that all trials share one layout.

    A physics step is `dt` long [s]. `padded` are numbers of solids of each kind, padding included.
    """
    spec = mujoco.MjSpec()
    spec.option.disableflags |= NO_AUTORESET
    add_scene(spec, track.scene, track.names, track.mesh_sizes, padded)
    return compile_quadrotor(spec, vehicle, dt)


class DepthCamera:
    """A depth camera whose images come from MuJoCo's ray casts."""

    def __init__(self, camera: Camera) -> None:
        """Make a camera with the image size and field of view of `camera`."""
        self.camera = camera
        self._rays_b = cast_rays_b(camera)

    def image(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        pos_w: np.ndarray,
        rot_w: np.ndarray,
        group: int | None = None,
    ) -> np.ndarray:
        """Return the planar depth image (H, W) [m], without the quadrotor itself.

        A pixel whose ray hits nothing gets the camera's range. The camera is at `pos_w` (3,) [m]
        with attitude `rot_w` (3, 3), body to world. `data` has computed positions of the solids.
        With `group`, only geoms (MuJoCo's solids) of it are visible.
        """
        # Rays have a component of 1 along the optical axis, so the ray parameter is planar depth.
        groups = None
        if group is not None:
            groups = (np.arange(mujoco.mjNGROUP) == group).astype(np.uint8)
        rays_w = (self._rays_b[:, None, :] * rot_w).sum(-1)
        count = len(rays_w)
        geom, depth = np.empty(count, np.int32), np.empty(count)
        mujoco.mj_multiRay(
            model,
            data,
            pos_w,
            rays_w.ravel(),
            groups,
            True,
            BODY,
            geom,
            depth,
            None,
            count,
            # A shorter cut-off would also skip the ground if its origin is further away.
            mujoco.mjMAXVAL,
        )
        depth = np.where(geom < 0, self.camera.range_m, depth)
        return nearest(self.camera, np.minimum(depth, self.camera.range_m))


def motion_of(data: mujoco.MjData) -> Motion:
    """Return the quadrotor's state as a batch of one; `mj_step1` must have been run on `data`."""
    rot_w = data.xmat[BODY].reshape(1, 3, 3).copy()
    pos_w, velocity = data.qpos[None, :3].copy(), data.qvel[None].copy()
    return Motion(pos_w, rot_w, velocity[:, :3], velocity[:, 3:])


class OneTrial:
    """The trial of one vehicle, whose state the caller holds as `MjData`, by the judge's rules."""

    progress: Progress
    """Progress of the trial, a batch of one."""

    def __init__(self, track: Track, vehicle: Vehicle, dt: float, rules: Rules) -> None:
        """Compile the model of `vehicle` on `track`, for physics steps of `dt` [s]."""
        self.model = compile_model(track, vehicle, dt, layout_of([track]).solids)
        self.rules, self._dt, self._start = rules, dt, start_state(track)
        gates = Gates(*(np.asarray(field)[None] for field in track.scene.gates))
        self.course = Course(gates, np.array([gates.center_w.shape[1]], np.int32))

    def put_at_start(self, data: mujoco.MjData) -> Motion:
        """Put the vehicle at the start, and return its state; `data` has just been reset."""
        data.qpos[:], data.qvel[:] = self._start, 0.0
        mujoco.mj_step1(self.model, data)
        motion = motion_of(data)
        self.progress = start_progress(motion.pos_w)
        return motion

    def move(self, data: mujoco.MjData, motion: Motion, wrench: Wrench) -> None:
        """Make one physics step from `motion`, and judge the state after it.

        An invalid force or torque ends the trial without a step.
        """
        diverged = ~is_wrench(self.rules, wrench)
        if not diverged[0]:
            data.qfrc_applied[:3] = to_world(motion.rot_w, wrench.force_b)[0]
            data.qfrc_applied[3:] = wrench.torque_b[0]
            mujoco.mj_step2(self.model, data)
            diverged = has_diverged(self.rules, motion_of(data))
        self.progress = self.progress._replace(step=self.progress.step + np.int32(1))
        if not diverged[0]:
            mujoco.mj_step1(self.model, data)
        self.judge(data, diverged)

    def judge(self, data: mujoco.MjData, diverged: np.ndarray) -> None:
        """Update the progress (gates, collision, time, ...) by the judge's rules."""
        motion, contact = motion_of(data), np.array([data.ncon > 0])
        with np.errstate(invalid="ignore", over="ignore"):
            self.progress = judge_state(
                self.rules, self.progress, self.course, self._dt, motion, contact, diverged
            )


def contact_name(model: mujoco.MjModel, data: mujoco.MjData) -> str:
    """Return the name of the solid with the deepest contact in `data`."""
    deepest = min(data.contact, key=lambda contact: contact.dist)
    first_is_body = int(model.geom_bodyid[deepest.geom[0]]) == BODY
    return solid_name(model.geom(int(deepest.geom[1 if first_is_body else 0])).name)


def course_notes(name: str, track: Track, vehicle: Vehicle) -> list[str]:
    """Return notes on what is probably a mistake in a track from a file that `vehicle` flies.

    Raises:
        ValueError: for an impossible track (`tracks.track_check`), or if the vehicle is in contact
            at the start, with the start and the touched solid.
    """
    check_track(track)
    if contact := start_contact(track, vehicle):
        raise ValueError(f"{name}: at start.position {contact}")
    return track_doubts(name, track, vehicle)


def start_contact(track: Track, vehicle: Vehicle) -> str:
    """Return the start and the solid that `vehicle` touches there, as a text; "" for none."""
    model = compile_model(track, vehicle, 1.0 / vehicle.controller.frequency, counts(track.scene))
    data = mujoco.MjData(model)
    data.qpos[:] = start_state(track)
    mujoco.mj_forward(model, data)
    if not data.ncon:
        return ""
    sides = " x ".join(f"{2 * size:g}" for size in vehicle.body.half_size)
    return (
        f"{np.round(track.start_pos_w, 3).tolist()} the body of {vehicle.name!r} ({sides} m) "
        f"touches {contact_name(model, data)}; move the start away"
    )


def family_notes(family: str, level: int, seed: int, vehicle: Vehicle) -> list[str]:
    """Return notes on what is probably a mistake in a family that the suite does not ship.

    One track of the family is examined, which `vehicle` flies.
    """
    if family in FAMILIES.own:
        return []
    track = make_track(family, level, seed)
    contact = start_contact(track, vehicle)
    notes = [f"{family}: at its start {contact}"] if contact else []
    return [*notes, *track_doubts(family, track, vehicle)]


def track_doubts(name: str, track: Track, vehicle: Vehicle) -> list[str]:
    """Return notes on what is probably a mistake in a track, and on gates too small to fly."""
    return [*track_notes(name, track), *opening_notes(name, track, vehicle)]


def opening_notes(name: str, track: Track, vehicle: Vehicle) -> list[str]:
    """Return a note on the first gate that is too small for the body of `vehicle`, [] for none."""
    # Width and height (N, 2) of the gates, and of the body; the vehicle may fly rolled by 90 deg.
    openings = np.ptp(track.scene.gates.opening_g, axis=1)
    body = 2 * np.sort(vehicle.body.half_size[1:])
    small = np.flatnonzero((np.sort(openings) <= body).any(axis=1))
    return [
        f"{name}: gate {gate} is {openings[gate][0]:g} x {openings[gate][1]:g} m, too small for "
        f"the body of {vehicle.name!r} ({body[1]:g} x {body[0]:g} m)"
        for gate in small[:1]
    ]


def warn_of(notes: Iterable[object]) -> None:
    """Issue each note as a Python warning at the line of the caller's caller."""
    for note in notes:
        warnings.warn(str(note), stacklevel=3)


def start_state(track: Track) -> np.ndarray:
    """Return the free joint's state (7,) at the start of `track`: position [m], quaternion wxyz."""
    half_yaw = track.start_yaw / 2
    return np.array([*track.start_pos_w, np.cos(half_yaw), 0.0, 0.0, np.sin(half_yaw)])

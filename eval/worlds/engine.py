"""Shared parts of the simulators on MuJoCo's C engine: models, rays and contacts."""

from __future__ import annotations

import mujoco
import numpy as np

from eval.quadrotor.model import compile_quadrotor
from eval.quadrotor.plant import Motion
from eval.vehicles.vehicle import Vehicle
from tracks.formats.mujoco_scene import add_scene, solid_name
from tracks.geometry.camera import Camera, cast_rays_b, nearest
from tracks.geometry.scene import Counts, counts
from tracks.track import Track

BODY = 1
"""Number of the quadrotor's body: the first after the world body."""
NO_AUTORESET = mujoco.mjtDisableBit.mjDSBL_AUTORESET
"""Disables MuJoCo's reset of invalid states, which the judge must detect."""


def compile_model(track: Track, vehicle: Vehicle, dt: float, to: Counts) -> mujoco.MjModel:
    """Return the model of a vehicle on a track, padded so that all trials share one layout.

    Args:
        track: with its scene.
        vehicle: that flies.
        dt: length of a physics step [s].
        to: padded number of solids of each kind.
    """
    spec = mujoco.MjSpec()
    spec.option.disableflags |= NO_AUTORESET
    add_scene(spec, track.scene, track.names, track.mesh_sizes, to)
    return compile_quadrotor(spec, vehicle, dt)


class Eye:
    """A depth camera that uses MuJoCo's rays."""

    def __init__(self, camera: Camera) -> None:
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
        """Return the planar depth image (H, W) [m] from pos_w (3,) and rot_w (3, 3).

        The quadrotor itself is not seen, and of a `group` of geoms nothing but that. The solids'
        places must be computed in `data`. Rays have an optical-axis component of 1, so the ray
        parameter is the planar depth; rays that hit nothing read as the range.
        """
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
            # A shorter cut-off would also skip the ground where its origin is further away.
            mujoco.mjMAXVAL,
        )
        depth = np.where(geom < 0, self.camera.range_m, depth)
        return nearest(self.camera, np.minimum(depth, self.camera.range_m))


def motion_of(data: mujoco.MjData) -> Motion:
    """Return the quadrotor's state as a batch of one; needs the results of `mj_step1` in `data`."""
    rot_w = data.xmat[BODY].reshape(1, 3, 3).copy()
    pos_w, velocity = data.qpos[None, :3].copy(), data.qvel[None].copy()
    return Motion(pos_w, rot_w, velocity[:, :3], velocity[:, 3:])


def contact_name(model: mujoco.MjModel, data: mujoco.MjData) -> str:
    """Return the name of the solid with the deepest contact in `data`."""
    deepest = min(data.contact, key=lambda contact: contact.dist)
    own = [int(model.geom_bodyid[geom]) == BODY for geom in deepest.geom]
    return solid_name(model.geom(int(deepest.geom[1 if own[0] else 0])).name)


def refuse_start_contact(name: str, track: Track, vehicle: Vehicle) -> None:
    """Refuse a track on which `vehicle` is in contact at the start.

    Raises:
        ValueError: naming the track, the start and the touched solid.
    """
    model = compile_model(track, vehicle, 1.0 / vehicle.controller.frequency, counts(track.scene))
    data = mujoco.MjData(model)
    data.qpos[:] = start_state(track)
    mujoco.mj_forward(model, data)
    if data.ncon:
        half = " x ".join(f"{2 * size:g}" for size in vehicle.body.half_size)
        raise ValueError(
            f"{name}: at start.position {np.round(track.start_pos_w, 3).tolist()} the body of "
            f"{vehicle.name!r} ({half} m) touches {contact_name(model, data)}; move the start away"
        )


def start_state(track: Track) -> np.ndarray:
    """Return the free joint's (7,) position and quaternion wxyz at the start of `track`."""
    half = track.start_yaw / 2
    return np.array([*track.start_pos_w, np.cos(half), 0.0, 0.0, np.sin(half)])

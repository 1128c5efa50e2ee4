"""A track's scene in MuJoCo and as a batch, and poses in it to look from."""

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from tracks.formats.mujoco_scene import add_scene
from tracks.geometry.scene import Counts, Scene, counts, stack
from tracks.track import Track

POSES = 12


def model_of(
    track: Track, pad_to: Counts | None = None, drone: bool = False
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return MuJoCo's model of the scene, also with a body at the start, and its data at rest."""
    spec = mujoco.MjSpec()
    add_scene(spec, track.scene, track.names, track.mesh_sizes, pad_to)
    if drone:
        body = spec.worldbody.add_body(name="drone", pos=track.start_pos_w)
        body.add_freejoint()
        box = mujoco.mjtGeom.mjGEOM_BOX
        body.add_geom(name="drone", type=box, size=[0.064, 0.064, 0.025], mass=0.75)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def free_poses(model, data, track: Track, rng, n=POSES):
    """Return poses around the track that lie in no solid, tilted any way up to 60 degrees."""
    low, high = track.scene.gates.center_w.min(0) - 3, track.scene.gates.center_w.max(0) + 3
    low[2], high[2] = 0.2, 4
    pos_w = []
    six_ways = np.concatenate([np.eye(3), -np.eye(3)])
    while len(pos_w) < n:
        pos = rng.uniform(low, high)
        geom = np.zeros(1, np.int32)
        ahead = [mujoco.mj_ray(model, data, pos, d, None, True, -1, geom) for d in six_ways]
        # A ray that starts inside a solid meets its wall from within, both ways.
        if min(d for d in [*ahead, np.inf] if d >= 0) > 0.6:
            pos_w.append(pos)
    angle = rng.uniform([-np.pi, -1, -1], [np.pi, 1, 1], (n, 3))
    return np.array(pos_w), Rotation.from_euler("ZYX", angle).as_matrix()


def batch(track: Track, n: int, to=None) -> Scene:
    """Return the track's scene `n` times, padded to the counts `to`."""
    to = counts(track.scene) if to is None else to
    return stack([track.scene] * n, to)


def by_mujoco(model, data, pos_w, rot_w, rays_b, range_m):
    """Return planar depths (P, R) [m] by mj_multiRay, and the geoms hit."""
    depths, hits = [], []
    for pos, rot in zip(pos_w, rot_w, strict=True):
        direction = np.ascontiguousarray(rays_b @ rot.T)
        length = np.linalg.norm(direction, axis=-1)
        geom, distance = np.zeros(len(rays_b), np.int32), np.zeros(len(rays_b))
        mujoco.mj_multiRay(
            model, data, pos, (direction / length[:, None]).ravel(), None, True, -1,
            geom, distance, None, len(rays_b), mujoco.mjMAXVAL,
        )  # fmt: skip
        depths.append(np.where(distance < 0, range_m, np.minimum(distance / length, range_m)))
        hits.append(geom)
    return np.array(depths), np.array(hits)

"""Nearest distances against MuJoCo's geom distances and trimesh."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh

from tracks.families import MAX_COUNTS, make_track
from tracks.formats.custom import load_track
from tracks.formats.meshes import solid_meshes
from tracks.formats.mujoco_scene import add_scene
from tracks.geometry.clearance import distances, nearest_obstacle
from tracks.geometry.scene import counts, stack

BALL = 1e-3
all_distances = jax.jit(distances)
nearest = jax.jit(nearest_obstacle, static_argnames="limits")


def random_points(track, n, seed):
    center = track.scene.gates.center_w
    low, high = center.min(0) - 3, center.max(0) + 3
    low[2], high[2] = 0.05, 4
    return np.random.default_rng(seed).uniform(low, high, (n, 3))


def unbatched(scene):
    return jax.tree.map(lambda a: np.asarray(a, np.float32), scene)


@pytest.mark.parametrize("family", ["zigzag", "random"])
def test_distances_outside_are_mujocos(family):
    track = make_track(family, 9, 6)
    spec = mujoco.MjSpec()
    add_scene(spec, track.scene, track.names)
    probe = spec.worldbody.add_body(name="probe")
    probe.add_freejoint()
    probe.add_geom(name="probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[BALL, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    geom = model.geom("probe").id
    solids = [i for i in range(model.ngeom) if i != geom]
    assert model.geom(solids[-1]).name == "ground"
    for point in random_points(track, 12, 1):
        data.qpos[:3] = point
        mujoco.mj_kinematics(model, data)
        expected = [mujoco.mj_geomDistance(model, data, i, geom, 100, None) for i in solids]
        expected = np.array(expected) + BALL
        distance, _ = all_distances(unbatched(track.scene), jnp.asarray(point))
        free = expected > 0.01
        assert np.allclose(np.asarray(distance)[free], expected[free], atol=2e-3)
        assert np.all(np.asarray(distance)[~free] < 0.012)


def test_distances_to_boxes_are_trimeshs_inside_too():
    track = make_track("ellipse", 9, 2)
    boxes = track.scene.boxes
    rng = np.random.default_rng(3)
    inside_b = rng.uniform(-0.9, 0.9, boxes.half_size.shape) * boxes.half_size
    inside = boxes.center_w + (boxes.rot_w @ inside_b[..., None])[..., 0]
    point = np.concatenate([inside, random_points(track, 60, 4)])
    distance, _ = all_distances(unbatched(track.scene), jnp.asarray(point))
    number = len(boxes.center_w)
    for i, (_, mesh) in enumerate(solid_meshes(track)[:number]):
        expected = box_distance(mesh, point)
        assert np.allclose(distance[:, i], expected, atol=1e-4)
    assert np.all(np.asarray(distance)[np.arange(number), np.arange(number)] < 0)


def box_distance(mesh, point):
    """Return signed distances to a convex mesh, positive outside, by trimesh's closest points."""
    _, gap, _ = trimesh.proximity.closest_point_naive(mesh, point)
    height = np.sum((point[:, None] - mesh.triangles[:, 0]) * mesh.face_normals, -1)
    return np.where(height.max(-1) < 0, -gap, gap)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_nearest_point_is_on_a_surface_and_the_way_out_is_free(seed):
    track = make_track("zigzag", 9, seed)
    scene = unbatched(track.scene)
    point = random_points(track, 400, seed).astype(np.float32)
    batched = jax.tree.map(lambda a: a[None], scene)
    distance, away = (np.asarray(a)[0] for a in nearest(batched, point[None]))
    every, _ = all_distances(scene, point)
    assert np.allclose(distance, np.asarray(every).min(-1), atol=1e-6)
    assert np.allclose(np.linalg.norm(away, axis=-1), 1, atol=1e-5)
    surface = point - distance[:, None] * away
    at_surface, _ = all_distances(scene, surface)
    clear = distance > 0
    # From inside of one solid the way out may lead into another.
    assert np.allclose(np.asarray(at_surface).min(-1)[clear], 0, atol=1e-4)
    ahead, _ = all_distances(scene, point + 1e-2 * away)
    growth = (np.take_along_axis(np.asarray(ahead), np.asarray(every).argmin(-1)[:, None], 1))[:, 0]
    assert np.allclose(growth - distance, 1e-2, atol=2e-4)


def test_meshes_are_as_far_as_trimesh_says(root):
    track = load_track(root / "tracks" / "examples" / "yard.toml")
    point = random_points(track, 300, 5)
    distance, _ = all_distances(unbatched(track.scene), jnp.asarray(point))
    primitive = sum(counts(track.scene)[:4])
    first = primitive
    for (_, mesh), size in zip(solid_meshes(track)[-2:], track.mesh_sizes, strict=True):
        _, gap, _ = trimesh.proximity.closest_point_naive(mesh, point)
        mine = np.asarray(distance)[:, first : first + size].min(-1)
        assert np.allclose(mine, gap, atol=1e-4)
        first += size


def test_padding_and_culling_do_not_change_the_nearest():
    tracks = [make_track("circular", 9, 1), make_track("random", 9, 0)]
    scene = stack([t.scene for t in tracks], MAX_COUNTS)
    gates = np.array([t.scene.gates.center_w for t in tracks], np.float32)
    distance = np.asarray(nearest(scene, gates)[0])
    limits = MAX_COUNTS._replace(boxes=24, cylinders=6, capsules=5, spheres=5)
    for i, track in enumerate(tracks):
        alone, _ = all_distances(unbatched(track.scene), gates[i])
        assert np.allclose(distance[i], np.asarray(alone).min(-1), atol=1e-5)
    for k in range(8):
        culled, _ = nearest(scene, gates[:, k : k + 1], limits)
        assert np.allclose(np.asarray(culled)[:, 0], distance[:, k], atol=1e-5)

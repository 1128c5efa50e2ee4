"""Depth images and nearest distances against MuJoCo and trimesh."""

import dataclasses
from dataclasses import replace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tests.support.marks import more
from tests.support.scene_poses import POSES, batch, by_mujoco, free_poses, model_of
from tracks.common.masks import take
from tracks.families import MAX_COUNTS, make_track
from tracks.formats.custom import load_track
from tracks.formats.meshes import solid_meshes
from tracks.formats.mujoco_scene import add_scene
from tracks.geometry import camera as cameras
from tracks.geometry import tiles
from tracks.geometry.camera import Camera, cast_rays_b, pixel_rays_b
from tracks.geometry.clearance import distances, nearest_obstacle
from tracks.geometry.depth import depth_image
from tracks.geometry.scene import Boxes, Rods, Spheres, counts, stack
from tracks.geometry.tiles import depth_images, make_tiles

CAMERA = Camera()
RAYS = pixel_rays_b(CAMERA)
render = jax.jit(depth_image, static_argnames=("range_m", "limits"))


def assert_same_but_at_silhouettes(depth, expected):
    """A ray that grazes an edge may fall on either side: at most one pixel in a thousand."""
    wrong = np.abs(depth - expected) > 1e-3 + 1e-3 * expected
    assert wrong.mean() < 1e-3
    assert np.ptp(expected) > 3


def seen(scene, pos_w, rot_w, limits=None):
    return np.asarray(render(scene, pos_w, rot_w, RAYS, CAMERA.range_m, limits=limits))


@pytest.mark.parametrize("family", ["zigzag", more("random")])
def test_depth_is_what_mujocos_rays_see_in_each_world_of_a_batch(family):
    tracks = [make_track(family, 9, seed) for seed in (1, 2)]
    poses, expected, kinds = [], [], set()
    for seed, track in enumerate(tracks):
        model, data = model_of(track)
        poses.append(free_poses(model, data, track, np.random.default_rng(seed)))
        depth, geoms = by_mujoco(model, data, *poses[-1], RAYS, CAMERA.range_m)
        expected.append(depth)
        kinds |= {mujoco.mjtGeom(model.geom_type[g]).name for g in np.unique(geoms) if g >= 0}
    scenes = stack([track.scene for track in tracks for _ in range(POSES)], MAX_COUNTS)
    pos_w, rot_w = (np.concatenate(parts) for parts in zip(*poses, strict=True))
    depth = seen(scenes, pos_w, rot_w)
    assert_same_but_at_silhouettes(depth, np.concatenate(expected))
    if family != "random":
        solids = ("PLANE", "BOX", "CYLINDER", "CAPSULE", "SPHERE")
        assert kinds >= {f"mjGEOM_{kind}" for kind in solids}


def test_meshes_and_polygonal_gates_are_seen_alike(root):
    track = load_track(root / "tracks" / "examples" / "yard.toml")
    model, data = model_of(track)
    pos_w, rot_w = free_poses(model, data, track, np.random.default_rng(0), 40)
    expected, geoms = by_mujoco(model, data, pos_w, rot_w, RAYS, CAMERA.range_m)
    meshes = [i for i in range(model.ngeom) if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_MESH]
    assert np.isin(geoms, meshes).mean() > 0.003
    assert_same_but_at_silhouettes(seen(batch(track, 40), pos_w, rot_w), expected)


@pytest.mark.extended
def test_culling_that_keeps_enough_changes_nothing():
    track = make_track("ellipse", 9, 3)
    poses = free_poses(*model_of(track), track, np.random.default_rng(7), 2 * POSES)
    scene, have = batch(track, 2 * POSES, MAX_COUNTS), counts(track.scene)
    some = have._replace(boxes=have.boxes - 12, cylinders=8, capsules=6, spheres=6)
    # Two programs round differently, relative to the distance; a lost object is off by centimetres.
    culled, whole = seen(scene, *poses, limits=some), seen(scene, *poses)
    np.testing.assert_allclose(culled, whole, rtol=1e-4, atol=1e-4)


def test_culling_keeps_what_only_reaches_into_view():
    """A long box whose middle is out of view is kept before a far one in the middle of it."""
    boxes = Boxes(
        np.array([[3.0, 5.0, 50.0], [6.0, 0.0, 51.0], [8.0, -1.0, 52.0]]),
        np.tile(np.eye(3), (3, 1, 1)),
        np.array([[0.1, 4.5, 0.3], [0.2, 0.2, 0.2], [0.2, 0.2, 0.2]]),
    )
    track = make_track("zigzag", 0, 0)
    track = replace(track, scene=track.scene._replace(boxes=boxes))
    scene = batch(track, 2 * POSES, MAX_COUNTS)
    pose = np.tile([0.0, 0.0, 50.0], (2 * POSES, 1)), np.tile(np.eye(3), (2 * POSES, 1, 1))
    limits = MAX_COUNTS._replace(boxes=2)
    whole, culled = seen(scene, *pose)[0], seen(scene, *pose, limits=limits)[0]
    near = whole < 7
    assert 20 < near.sum() < 400 and np.any((whole > 7) & (whole < 9))
    assert np.allclose(culled[near], whole[near], atol=1e-5)
    assert np.all(culled[~near] > 7)


SAME_M = 1e-9
"""Depths agree to this, but for rays that graze an edge [m]."""
GRAZING = 1e-4
"""Share of rays that may graze, and then fall on either side."""
FINE = Camera(rays=2)


def batched(track, n, to=None):
    return stack([track.scene] * n, counts(track.scene) if to is None else to, np.float64)


def tiled(camera, track, pos_w, rot_w, to=None):
    return depth_images(make_tiles(camera), batched(track, len(pos_w), to), pos_w, rot_w)


def seen_by_mujoco(camera, model, data, pos_w, rot_w):
    depth, geoms = by_mujoco(model, data, pos_w, rot_w, cast_rays_b(camera), camera.range_m)
    return cameras.nearest(camera, depth), geoms


def assert_same(found, expected):
    assert found.shape == expected.shape
    assert (np.abs(found - expected) > SAME_M).mean() <= GRAZING
    assert np.ptp(expected) > 3


@pytest.mark.parametrize(
    ("name", "camera"),
    [
        (("zigzag", 0, 3), FINE),
        (("zigzag", 9, 3), FINE),
        (("random", 9, 3), FINE),
        (("ellipse", 9, 3), Camera(width=7, height=5, rays=3, pitch_deg=-40.0)),
        (("circular", 9, 4), Camera(width=20, height=20, fov_deg=(150.0, 140.0), range_m=40.0)),
        (("circular", 9, 4), Camera(width=3, height=2, rays=8, range_m=4.0)),
    ],
)
def test_any_track_looks_to_any_camera_as_in_mujoco(name, camera):
    track = make_track(*name)
    model, data = model_of(track)
    pos_w, rot_w = free_poses(model, data, track, np.random.default_rng(0), 2 * POSES)
    expected, _ = seen_by_mujoco(camera, model, data, pos_w, rot_w)
    assert_same(tiled(camera, track, pos_w, rot_w, MAX_COUNTS), expected)


def crowd(kind, rng, n=40):
    """Return a track with n solids of one kind, of all shapes, and the ground."""
    track = make_track("zigzag", 0, 0)
    center_w = rng.uniform([-4.0, -4.0, 0.0], [4.0, 4.0, 4.0], (n, 3))
    rot_w = Rotation.random(n, rng).as_matrix()
    rot_w[: n // 4] = np.eye(3)  # rays that run along a side or an axis
    size = np.exp(rng.uniform(np.log(0.02), np.log(1.0), (n, 3)))
    rods = Rods(center_w, rot_w[:, :, 2], size[:, 0], size[:, 1])
    solids = {
        "boxes": Boxes(center_w, rot_w, size),
        "cylinders": rods,
        "capsules": rods,
        "spheres": Spheres(center_w, size[:, 0]),
    }
    none = track.scene._replace(
        **{name: take(getattr(track.scene, name), slice(0, 0)) for name in solids}
    )
    return dataclasses.replace(track, scene=none._replace(**{kind: solids[kind]}), names=())


@pytest.mark.parametrize("kind", ["boxes", "cylinders", "capsules", "spheres"])
def test_each_kind_of_solid_looks_as_in_mujoco(kind):
    rng = np.random.default_rng(7)
    track = crowd(kind, rng)
    model, data = model_of(track)
    yaw = rng.uniform(-np.pi, np.pi, 2 * POSES)
    yaw[:4] = np.arange(4) * np.pi / 2
    pos_w = np.stack([-7 * np.cos(yaw), -7 * np.sin(yaw), rng.uniform(0.5, 3.0, len(yaw))], -1)
    tilt = rng.uniform(-0.5, 0.5, (len(yaw), 2))
    tilt[:4] = 0.0
    rot_w = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt])).as_matrix()
    expected, geoms = seen_by_mujoco(FINE, model, data, pos_w, rot_w)
    assert ((geoms >= 0) & (geoms < model.ngeom - 1)).mean() > 0.05, "solids, not the ground"
    assert_same(tiled(FINE, track, pos_w, rot_w), expected)


def test_an_image_is_its_cameras_alone(monkeypatch):
    """To the bit, whatever is beside it, however much is worked on at once, and any padding."""
    track, other = make_track("ellipse", 9, 1), make_track("ellipse", 4, 2)
    model, data = model_of(track)
    pos_w, rot_w = free_poses(model, data, track, np.random.default_rng(5))
    together = tiled(FINE, track, pos_w, rot_w, MAX_COUNTS)
    scene = stack([track.scene, other.scene] * POSES, MAX_COUNTS, np.float64)
    mixed = depth_images(make_tiles(FINE), scene, np.repeat(pos_w, 2, 0), np.repeat(rot_w, 2, 0))
    np.testing.assert_array_equal(mixed[::2], together)
    monkeypatch.setattr(tiles, "PAIRS_AT_ONCE", 37)
    monkeypatch.setattr(tiles, "RAYS_AT_ONCE", 10_000)
    for part in (slice(0, 1), slice(3, 8), slice(None, None, -1)):
        alone = tiled(FINE, track, pos_w[part], rot_w[part])
        np.testing.assert_array_equal(alone, together[part])


def test_special_places_inside_a_solid_above_and_below_the_ground_and_none_at_all():
    track = crowd("spheres", np.random.default_rng(0), 1)
    center_w = track.scene.spheres.center_w
    level = np.eye(3)[None]
    assert (tiled(FINE, track, center_w, level) == 0).all()
    assert (tiled(FINE, track, np.array([[50.0, 0.0, -1.0]]), level) == FINE.range_m).all()
    ground = tiled(FINE, track, np.array([[50.0, 0.0, 1.0]]), level)
    assert (ground[0, -1] < 4.0).all() and (ground[0, 0] == FINE.range_m).all()
    nothing = take((batched(track, 1), np.zeros((1, 3)), level), slice(0))
    assert depth_images(make_tiles(FINE), *nothing).shape == (0, 24, 32)


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


@pytest.mark.parametrize("family", ["zigzag", more("random")])
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
    point = np.concatenate([inside, random_points(track, 20, 4)])
    distance, _ = all_distances(unbatched(track.scene), jnp.asarray(point))
    number = len(boxes.center_w)
    meshes = solid_meshes(track)
    for i in range(0, number, 4):
        assert np.allclose(distance[:, i], box_distance(meshes[i][1], point), atol=1e-4)
    assert np.all(np.asarray(distance)[np.arange(number), np.arange(number)] < 0)


def box_distance(mesh, point):
    """Return signed distances to a convex mesh, positive outside, by trimesh's closest points."""
    _, gap, _ = trimesh.proximity.closest_point_naive(mesh, point)
    height = np.sum((point[:, None] - mesh.triangles[:, 0]) * mesh.face_normals, -1)
    return np.where(height.max(-1) < 0, -gap, gap)


@pytest.mark.parametrize("seed", [0, more(1)])
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

"""Collisions, contacts and rays: by hand, and as MuJoCo finds them."""

import dataclasses

import jax
import mujoco
import numpy as np
import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.collision import NEAR, box_distances, near_solids
from eval.worlds.engine import BODY, DepthCamera, compile_model, start_state
from eval.worlds.mujoco import MujocoWorld
from eval.worlds.scene_slots import TO_CONTACTS
from eval.worlds.slots import layout_of
from eval.worlds.trial import Rules, TrialSpec
from tests.support.courses import straight
from tracks.families import MAX_COUNTS
from tracks.formats.custom import load_track
from tracks.formats.mujoco_scene import MESH_GROUP
from tracks.geometry.camera import Camera, pixel_rays_b
from tracks.geometry.rotation import exp_rot
from tracks.geometry.scene import Boxes, Counts, Rods, Spheres, stack

distances = jax.jit(box_distances)
nearest = jax.jit(near_solids)


# The box's front face, and its front edge once it is turned by 45 degrees.
@pytest.mark.parametrize(("turn", "reach"), [(0.0, 0.1), (np.pi / 4, 0.15 / 2**0.5)])
def test_distance_to_a_wall_and_to_the_ground_by_hand(turn, reach):
    scene = stack([straight(wall_at=3.0).scene], MAX_COUNTS)
    pos_w, rot_w = np.array([[0.0, 0.0, 1.5]]), exp_rot(np.array([[0.0, 0.0, turn]]))
    half_size, middle_b = np.array([0.1, 0.05, 0.02]), np.array([0.0, 0.0, -0.01])
    found = np.asarray(distances(scene, pos_w, rot_w, half_size, middle_b))[0]
    assert found[0] == pytest.approx(2.95 - reach, abs=1e-3)
    assert found[-1] == pytest.approx(1.5 - 0.01 - 0.02)


def test_long_walls_far_away_do_not_hide_a_box_near_by():
    walls = [[0.0, 20.0 + k, 5.0] for k in range(NEAR.boxes)]
    center_w = np.array([*walls, [1.0, 0.0, 1.0]])
    half_size = np.array([*[[100.0, 0.1, 5.0]] * NEAR.boxes, [0.1, 0.1, 0.1]])
    turned = np.tile(np.eye(3), (len(center_w), 1, 1))
    scene = straight().scene._replace(boxes=Boxes(center_w, turned, half_size))
    near = nearest(stack([scene], MAX_COUNTS), np.array([[0.0, 0.0, 1.0]]))
    assert near.boxes.center_w.shape == (1, NEAR.boxes, 3)
    np.testing.assert_allclose(near.boxes.center_w[0, 0], center_w[-1])


def test_every_triangle_of_a_mesh_is_near():
    triangles = np.arange(5 * 9.0).reshape(5, 3, 3)
    scene = straight().scene._replace(triangles=triangles)
    near = nearest(stack([scene], MAX_COUNTS._replace(triangles=5)), np.zeros((1, 3)))
    np.testing.assert_array_equal(near.triangles, triangles[None])


GEOM = mujoco.mjtGeom
SOLIDS = {
    "a wall": (GEOM.mjGEOM_BOX, (5.0, 0.05, 3.0)),
    "a bar": (GEOM.mjGEOM_BOX, (0.6, 0.05, 0.05)),
    "a plate": (GEOM.mjGEOM_BOX, (0.4, 0.4, 0.03)),
    "a pole": (GEOM.mjGEOM_CYLINDER, (0.05, 1.5)),
    "a disc": (GEOM.mjGEOM_CYLINDER, (0.5, 0.03)),
    "a pillar": (GEOM.mjGEOM_CAPSULE, (0.1, 1.0)),
    "a needle": (GEOM.mjGEOM_CAPSULE, (0.02, 1.5)),
    "a ball": (GEOM.mjGEOM_SPHERE, (0.3,)),
    "a mesh": (GEOM.mjGEOM_MESH, (0.6, 0.3, 0.2)),
}


def alone(geom, size):
    """Return a scene with one solid in the origin, 50 m above the ground."""
    at = np.array([[0.0, 0.0, 50.0]])
    scene = straight().scene
    rods = Rods(at, np.array([[0.0, 0.0, 1.0]]), np.array(size[:1]), np.array(size[-1:]))
    if geom == GEOM.mjGEOM_BOX:
        return scene._replace(boxes=Boxes(at, np.eye(3)[None], np.array([size])))
    if geom == GEOM.mjGEOM_MESH:
        return scene._replace(triangles=wedge(size) + at)
    if geom == GEOM.mjGEOM_SPHERE:
        return scene._replace(spheres=Spheres(at, np.array(size)))
    kind = "cylinders" if geom == GEOM.mjGEOM_CYLINDER else "capsules"
    return scene._replace(**{kind: rods})


ONE_OF_EACH = Counts(1, 1, 1, 1, 4)
"""The counts of all scenes with one solid, so that they share one compiled program."""


def wedge(size):
    """Return the triangles of a tetrahedron that fills half a box."""
    corners = np.array([[-1, -1, -1], [1, -1, -1], [-1, 1, -1], [1, 1, 1]]) * np.array(size)
    return corners[[[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]]


@pytest.mark.parametrize("name", SOLIDS)
def test_no_contact_is_missed_and_none_made_up(name):
    """Bodies about each solid's surface: what only grazes may be told otherwise, 1 mm deep."""
    geom, size = SOLIDS[name]
    half_size = np.array([0.12, 0.09, 0.03])
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_freejoint()
    body.add_geom(type=GEOM.mjGEOM_BOX, size=half_size)
    about = {"type": geom, "pos": [0.0, 0.0, 50.0]}
    if geom == GEOM.mjGEOM_MESH:
        corners = wedge(size).reshape(-1, 3)
        spec.add_mesh(name="wedge", uservert=np.unique(corners, axis=0).ravel().tolist())
        geom_of = spec.worldbody.add_geom(meshname="wedge", **about)
    else:
        geom_of = spec.worldbody.add_geom(size=[*size, 0.0, 0.0][:3], **about)
    geom_of.margin = 2e-3  # so that what is 1 mm beside is told as well
    model = spec.compile()
    data = mujoco.MjData(model)
    rng, n = np.random.default_rng(1), 400
    round_kind = geom in (GEOM.mjGEOM_CYLINDER, GEOM.mjGEOM_CAPSULE)
    long = size[-1] + size[0] * (geom == GEOM.mjGEOM_CAPSULE)
    reach = np.array([size[0], size[0], long]) if round_kind else np.resize(size, 3)
    pos = rng.uniform(-1, 1, (n, 3)) * (reach + 0.12)
    face = rng.integers(3, size=n)
    pos[np.arange(n), face] = rng.choice([-1, 1], n) * (reach[face] + rng.uniform(0, 0.15, n))
    pos[:, 2] += 50.0
    quat = rng.normal(size=(n, 4))
    gap, rot = np.full(n, 0.01), np.zeros((n, 3, 3))
    for k in range(n):
        data.qpos[:3], data.qpos[3:] = pos[k], quat[k]
        mujoco.mj_step1(model, data)
        gap[k] = min((contact.dist for contact in data.contact[: data.ncon]), default=0.01)
        rot[k] = data.xmat[1].reshape(3, 3)
    scene = alone(geom, size)
    batch = jax.tree.map(lambda a: np.repeat(a, n, 0), stack([scene], ONE_OF_EACH))
    found = np.asarray(
        distances(*jax.tree.map(np.float32, (batch, pos, rot, half_size, np.zeros(3))))
    )
    found = found[:, :-1].min(-1)
    met = found <= 0.0
    assert 0.05 < met.mean() < 0.7
    deep, apart = gap < -1e-3, gap > 1.5e-3
    if geom == GEOM.mjGEOM_CAPSULE:  # MuJoCo may miss one whose axis goes through the body
        apart &= found > 1e-5 - size[0]
    # A cylinder's rounds may leave some mm of its rim.
    missed = deep & ~met & (gap < (-6e-3 if geom == GEOM.mjGEOM_CYLINDER else 0.0))
    assert not missed.any() and not (apart & met).any()


VEHICLE = load_vehicle("reference")


@pytest.fixture(scope="module")
def wall():
    track = straight(wall_at=3.0)
    model = compile_model(track, VEHICLE, 0.002, layout_of([track]).solids)
    data = mujoco.MjData(model)
    mujoco.mj_step1(model, data)
    return track, model, data


def test_no_solid_of_a_file_is_called_as_a_geom_of_the_quadrotor(wall, tmp_path):
    _, model, _ = wall
    own = [model.geom(i).name for i in range(model.ngeom) if model.geom_bodyid[i]]
    path = tmp_path / "track.toml"
    for name in own:
        path.write_text(
            "[[gates]]\ncenter = [0, 0, 2]\nwidth = 1\nheight = 1\n"
            f'[[spheres]]\nname = "{name}"\ncenter = [5, 5, 5]\nradius = 1\n'
        )
        with pytest.raises(ValueError, match=rf"track.toml: spheres\[0\].name is '{name}'"):
            load_track(path)


def test_depth_is_planar_and_ends_at_the_range(wall):
    track, model, data = wall
    data.qpos[:] = start_state(track)
    mujoco.mj_step1(model, data)
    image = DepthCamera(Camera(pitch_deg=0.0)).image(model, data, data.qpos[:3], np.eye(3))
    middle = image[image.shape[0] // 2 - 1, image.shape[1] // 2]
    assert middle == pytest.approx(2.95)
    assert image.max() == Camera().range_m


@pytest.mark.parametrize(("rays", "seen"), [(1, False), (2, False), (4, True)])
def test_a_plate_on_edge_between_two_rays_is_seen_by_finer_ones(rays, seen):
    """It is 3 cm thick and 2 m away, where rays through pixels' centres are 10 cm apart."""
    track = straight(wall_at=2.05)
    boxes = track.scene.boxes
    plate = boxes._replace(half_size=np.array([[0.05, 0.015, 1.0]]))
    track = dataclasses.replace(track, scene=track.scene._replace(boxes=plate))
    model = compile_model(track, VEHICLE, 0.002, layout_of([track]).solids)
    data = mujoco.MjData(model)
    mujoco.mj_step1(model, data)
    eye = DepthCamera(Camera(pitch_deg=0.0, rays=rays))
    image = eye.image(model, data, track.start_pos_w, np.eye(3))
    assert image.shape == (24, 32) and bool((abs(image - 2.0) < 1e-6).any()) == seen


@pytest.mark.parametrize("away", [0.0, 14.0, 1000.0])
def test_the_ground_is_seen_wherever_the_world_is_flown(wall, away):
    """MuJoCo's rays leave a plane out whose origin is beyond their cut-off."""
    _, model, data = wall
    camera, height = Camera(pitch_deg=0.0), 1.5
    image = DepthCamera(camera).image(model, data, np.array([-away, -away, height]), np.eye(3))
    down = -pixel_rays_b(camera)[:, 2].reshape(image.shape)
    ground = height / np.maximum(down, 1e-9)
    seen = (ground < camera.range_m) & (image > ground - 0.01)
    assert seen.sum() > 100
    np.testing.assert_allclose(image[seen], ground[seen], atol=1e-6)


def test_a_world_sees_what_mujocos_rays_see_meshes_too(root):
    track = load_track(root / "tracks" / "examples" / "yard.toml")
    assert track.mesh_sizes
    layout, camera = layout_of([track]), Camera(rays=2)
    world = MujocoWorld(VEHICLE, camera, layout, Rules(), slots=12)
    world.load([(slot, track, TrialSpec("yard.toml", 0, slot)) for slot in range(12)])
    model = compile_model(track, VEHICLE, world.dt, layout.solids)
    data = mujoco.MjData(model)
    yaw = np.arange(12) * np.pi / 6
    world._qpos[:, :2] += np.stack([np.cos(yaw), np.sin(yaw)], -1)
    world._qpos[:, 3], world._qpos[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
    world._batch.forward(np.arange(12, dtype=np.int32), stage=TO_CONTACTS)
    wanted = yaw < 6.0
    images, meshes = world.view(wanted).depth_m, 0
    mujoco.mj_kinematics(model, data)
    for slot in np.flatnonzero(wanted):
        pose = world._qpos[slot, :3].copy(), world._xmat[slot, BODY].reshape(3, 3).copy()
        expected = DepthCamera(camera).image(model, data, *pose)
        assert (np.abs(images[slot] - expected) > 1e-9).mean() < 2e-3  # rays that graze an edge
        meshes += (DepthCamera(camera).image(model, data, *pose, MESH_GROUP) < camera.range_m).sum()
    assert meshes > 50
    assert (images[~wanted] == camera.range_m).all()

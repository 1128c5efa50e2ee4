"""What the worlds on the C engine share: the model of a trial, its rays, its contacts."""

import dataclasses

import mujoco
import numpy as np
import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.engine import (
    BODY,
    DepthCamera,
    compile_model,
    contact_name,
    motion_of,
    start_state,
)
from eval.worlds.mujoco import MujocoWorld
from eval.worlds.scene_slots import TO_CONTACTS
from eval.worlds.slots import layout_of
from eval.worlds.trial import Rules, TrialSpec
from tests.support.courses import straight
from tracks.formats.custom import load_track
from tracks.formats.mujoco_scene import MESH_GROUP
from tracks.geometry.camera import Camera, pixel_rays_b

VEHICLE = load_vehicle("reference")


@pytest.fixture(scope="module")
def wall():
    track = straight(wall_at=3.0)
    model = compile_model(track, VEHICLE, 0.002, layout_of([track]).solids)
    data = mujoco.MjData(model)
    mujoco.mj_step1(model, data)
    return track, model, data


def test_the_quadrotor_is_the_first_body_and_starts_at_the_start(wall):
    track, model, data = wall
    assert model.body(BODY).name == "quadrotor"
    data.qpos[:], data.qvel[:] = start_state(track), [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
    mujoco.mj_step1(model, data)
    motion = motion_of(data)
    np.testing.assert_array_equal(motion.pos_w[0], track.start_pos_w)
    np.testing.assert_array_equal(motion.rot_w[0], np.eye(3))
    np.testing.assert_array_equal(motion.vel_w[0], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(motion.rate_b[0], [0.1, 0.2, 0.3])


def test_no_solid_of_a_file_is_called_as_a_geom_of_the_quadrotor(wall, tmp_path):
    _, model, _ = wall
    own = [model.geom(i).name for i in range(model.ngeom) if model.geom_bodyid[i]]
    assert len(own) == 9
    for name in own:
        path = tmp_path / "track.toml"
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


@pytest.mark.parametrize("away", [0.0, 5.0, 14.0, 15.0, 40.0, 1000.0])
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


def test_a_contact_has_the_solids_name(wall):
    track, model, data = wall
    data.qpos[:] = start_state(track)
    data.qpos[0] = 2.9
    mujoco.mj_step1(model, data)
    assert data.ncon > 0 and contact_name(model, data) == "the wall"


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

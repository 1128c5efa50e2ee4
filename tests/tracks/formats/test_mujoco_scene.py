"""A scene as MuJoCo model: every solid in its place, named, colliding; one size if padded."""

import jax
import mujoco
import numpy as np
import pytest
from mujoco import batch

from tests.support.scene_poses import model_of
from tracks.families import FAMILIES, MAX_COUNTS, make_track
from tracks.formats.custom import load_track
from tracks.formats.meshes import solid_meshes
from tracks.formats.mujoco_scene import GROUND, PARKED, add_scene, solid_name
from tracks.geometry.clearance import distances
from tracks.geometry.scene import PARKED_Z, Counts


def geom_names(model):
    return [model.geom(i).name for i in range(model.ngeom)]


@pytest.mark.parametrize("family", FAMILIES)
def test_geoms_are_the_solids_in_order(family):
    track = make_track(family, 7, 3)
    model, data = model_of(track)
    assert [solid_name(name) for name in geom_names(model)] == [*track.names, GROUND]
    scene = track.scene
    solids = (scene.boxes, scene.cylinders, scene.capsules, scene.spheres)
    center_w = np.concatenate([kind.center_w for kind in solids])
    assert np.allclose(data.geom_xpos[:-1], center_w)
    boxes = len(scene.boxes.center_w)
    assert np.allclose(data.geom_xmat[:boxes].reshape(-1, 3, 3), scene.boxes.rot_w)
    assert np.allclose(model.geom_size[:boxes], scene.boxes.half_size)
    rods = np.concatenate([scene.cylinders.axis_w, scene.capsules.axis_w])
    axis = data.geom_xmat.reshape(-1, 3, 3)[boxes : boxes + len(rods), :, 2]
    assert np.allclose(axis, rods)
    assert data.ncon == 0
    assert np.all(model.geom_contype == 1) and np.all(model.geom_conaffinity == 1)


def test_padded_scenes_fly_in_one_batch_and_padding_is_out_of_the_way():
    tracks = [make_track(family, level, 1) for family in FAMILIES for level in (0, 9)]
    models, datas = zip(*(model_of(track, MAX_COUNTS, True) for track in tracks), strict=True)
    assert {model.ngeom for model in models} == {sum(MAX_COUNTS) + 2}
    worlds = batch.Batch(models[0], len(models))
    worlds.set_models(models)
    for track, model, data in zip(tracks, models, datas, strict=True):
        parked = [i for i, name in enumerate(geom_names(model)) if solid_name(name) == PARKED]
        assert len(parked) == sum(MAX_COUNTS) - len(track.names)
        assert np.all(model.geom_pos[parked, 2] == PARKED_Z)
        assert data.ncon == 0


def test_the_drone_collides_with_every_solid_and_it_is_named():
    model, data = model_of(make_track("zigzag", 9, 2), MAX_COUNTS, drone=True)
    drone, kinds = model.geom("drone").id, ("gate 4 frame", "plate", "pillar", "small", "ground ")
    hit = [i for i, name in enumerate(geom_names(model)) if solid_name(name).startswith(kinds)]
    assert len(hit) > 20
    for i in hit:
        # Not at the very centre: there MuJoCo finds no contact between a box and a cylinder.
        data.qpos[:3] = model.geom_pos[i] + [0.01, 0.005, 0.005]
        mujoco.mj_forward(model, data)
        touched = {g for contact in data.contact for g in contact.geom}
        assert {i, drone} <= touched
    data.qpos[:3] = [-8, 0, 0.01]
    mujoco.mj_forward(model, data)
    touched = {model.geom(g).name for contact in data.contact for g in contact.geom}
    assert touched == {"drone", GROUND}


def test_meshes_are_their_convex_parts(root):
    track = load_track(root / "tracks" / "examples" / "yard.toml")
    model, data = model_of(track)
    first = 0
    for name, size in zip(track.names[-2:], track.mesh_sizes, strict=True):
        corners = track.scene.triangles[first : first + size].reshape(-1, 3)
        first += size
        geom = model.geom(name)
        mesh = model.geom_dataid[geom.id]
        begin = model.mesh_vertadr[mesh]
        vertex = model.mesh_vert[begin : begin + model.mesh_vertnum[mesh]]
        placed = data.geom_xpos[geom.id] + vertex @ data.geom_xmat[geom.id].reshape(3, 3).T
        gap = np.linalg.norm(placed[:, None] - corners, axis=-1)
        assert gap.min(0).max() < 1e-5 and gap.min(1).max() < 1e-5


def test_what_does_not_fit_is_refused_and_what_has_no_names_gets_them_by_kind():
    track = make_track("zigzag", 9, 0)
    with pytest.raises(ValueError, match="more than the 40"):
        add_scene(mujoco.MjSpec(), track.scene, track.names, pad_to=Counts(40, 20, 20, 20))
    with pytest.raises(ValueError, match="3 names for"):
        add_scene(mujoco.MjSpec(), track.scene, track.names[:3])
    scene = track.scene._replace(triangles=np.zeros((2, 3, 3)))
    with pytest.raises(ValueError, match="mesh_sizes add up to 0, the scene has 2"):
        add_scene(mujoco.MjSpec(), scene)
    spec = mujoco.MjSpec()
    add_scene(spec, jax.tree.map(np.float32, track.scene))
    names = geom_names(spec.compile())
    assert names[0] == "boxes 0" and "spheres 0" in names and len(set(names)) == len(names)


def test_a_mesh_has_its_solids_name_lies_on_it_and_fills_it():
    track = make_track("ellipse", 9, 5)
    meshes = solid_meshes(track)
    assert [name for name, _ in meshes] == list(track.names)
    corners = np.concatenate([mesh.vertices for _, mesh in meshes])
    solid = np.repeat(np.arange(len(meshes)), [len(mesh.vertices) for _, mesh in meshes])
    gap = np.asarray(jax.jit(distances)(jax.tree.map(np.float32, track.scene), corners)[0])
    assert np.abs(gap[np.arange(len(corners)), solid]).max() < 1e-4
    centers = [kind.center_w for kind in track.scene[1:5]]
    for (name, mesh), center_w in zip(meshes, np.concatenate(centers), strict=True):
        assert mesh.is_watertight and mesh.volume > 0, name
        assert np.allclose(mesh.center_mass, center_w, atol=1e-3), name
        # Its corners lie to all sides of the middle, so that it is the whole solid.
        ahead = (mesh.vertices - center_w) @ np.concatenate([np.eye(3), -np.eye(3)]).T
        assert (ahead.max(axis=0) > 0).all(), name

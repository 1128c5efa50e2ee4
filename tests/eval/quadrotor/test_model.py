"""The MuJoCo body: its mass, its rotors, what it hits and what sees it."""

import mujoco
import numpy as np
import pytest

from eval.quadrotor.model import BODY, CAMERA, COLLIDES, compile_quadrotor, rotor_name
from eval.quadrotor.vehicle_file import load_vehicle
from tests.support.vehicles import PLAIN, with_effects
from tracks.geometry.camera import optical_axis_b


def compiled(vehicle, ground=False):
    spec = mujoco.MjSpec()
    if ground:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    return compile_quadrotor(spec, vehicle, 0.002)


def push(model, control):
    """Return acceleration and angular acceleration (body axes) under a control, without gravity."""
    data = mujoco.MjData(model)
    model.opt.gravity[:] = 0.0
    data.ctrl[:] = control
    mujoco.mj_forward(model, data)
    return data.qacc[:3].copy(), data.qacc[3:].copy()


def test_body_is_the_vehicle():
    model = compiled(PLAIN)
    body = model.body(BODY)
    assert body.mass[0] == PLAIN.mass
    np.testing.assert_array_equal(body.inertia, PLAIN.inertia)
    np.testing.assert_array_equal(body.ipos, 0.0)
    np.testing.assert_array_equal(body.iquat, [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(model.opt.gravity, [0.0, 0.0, -9.81])
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert (model.nq, model.nv, model.nu) == (7, 6, 4)


# Front is x, left is y: what each rotor alone does, in the vehicle file's order.
TURNS = [
    ("front right, counter-clockwise", [-1, -1, -1]),
    ("rear right, clockwise", [-1, 1, 1]),
    ("rear left, counter-clockwise", [1, 1, -1]),
    ("front left, clockwise", [1, -1, 1]),
]


@pytest.mark.parametrize("index", range(4), ids=[name for name, _ in TURNS])
def test_each_motor_alone_turns_the_body_the_way_it_should(index):
    control = np.zeros(4)
    control[index] = 2.0
    acc, turn = push(compiled(PLAIN), control)
    np.testing.assert_allclose(acc, [0.0, 0.0, 2.0 / 0.75], atol=1e-12)
    np.testing.assert_array_equal(np.sign(turn), TURNS[index][1])
    x, y, _ = PLAIN.rotors.position[index]
    yaw = -PLAIN.rotors.spin[index] * 2.2e-8 / 1.6e-6
    np.testing.assert_allclose(turn * PLAIN.inertia, 2.0 * np.array([y, -x, yaw]), atol=1e-12)


def test_actuators_hover():
    vehicle = load_vehicle("reference")
    model = compiled(vehicle)
    data = mujoco.MjData(model)
    data.ctrl[:] = vehicle.mass * 9.81 / 4
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qacc, 0.0, atol=1e-9)
    np.testing.assert_allclose(model.actuator_ctrlrange[:, 1], vehicle.rotors.thrust_max)
    assert [model.actuator(i).name for i in range(4)] == [rotor_name(i) for i in range(4)]


def test_effects_on_the_body():
    vehicle = with_effects(
        mass_offset=(0.1,),
        inertia_scale=((0.8, 1.0, 1.25),),
        com_offset=((0.01, -0.02, 0.005),),
        frame_tilt=((0.01, 0.02),),
    )
    model = compiled(vehicle)
    assert model.body(BODY).mass[0] == pytest.approx(0.85)
    # No body has these moments; a fit may find them all the same, and they are flown.
    np.testing.assert_allclose(model.body(BODY).inertia, [0.002, 0.0021, 0.005375])
    np.testing.assert_allclose(model.geom(COLLIDES).pos, [-0.01, 0.02, -0.005])
    np.testing.assert_allclose(model.site("rotor_1").pos, [0.065, -0.08, -0.005])
    np.testing.assert_allclose(model.opt.gravity[:2], [-0.1962, 0.0981], rtol=1e-3)


def test_only_the_box_collides():
    model = compiled(PLAIN, ground=True)
    data = mujoco.MjData(model)
    data.qpos[2] = 0.026
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    data.qpos[2] = 0.024
    mujoco.mj_forward(model, data)
    assert data.ncon > 0
    assert {model.geom(g).name for c in data.contact for g in c.geom} == {"", COLLIDES}
    # On its side the arms would touch first, at 0.1 m.
    data.qpos[2:] = [0.066, np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0, 0.0]
    mujoco.mj_forward(model, data)
    assert data.ncon == 0


def test_visuals_do_not_block_rays():
    model = compiled(PLAIN, ground=True)
    data = mujoco.MjData(model)
    data.qpos[2] = 3.0
    mujoco.mj_forward(model, data)
    hit, distance = np.zeros(1, np.int32), np.zeros(1)
    above = np.array([0.075, 0.1, 3.5])  # straight above a rotor disk
    mujoco.mj_multiRay(
        model, data, above, np.array([0.0, 0, -1]), None, True, -1, hit, distance, None, 1, 10.0
    )
    assert distance[0] == pytest.approx(3.5)


def test_camera_looks_where_the_vehicle_file_says():
    model = compiled(PLAIN)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    axes = data.cam(CAMERA).xmat.reshape(3, 3)
    np.testing.assert_allclose(-axes[:, 2], optical_axis_b(PLAIN.camera), atol=1e-12)
    np.testing.assert_allclose(axes[:, 0], [0.0, -1.0, 0.0], atol=1e-12)
    assert model.camera(CAMERA).fovy[0] == 63.8


def test_qfrc_applied_is_the_wrench():
    """The interface a world uses: world force and body torque at the centre of mass."""
    model = compiled(PLAIN)
    data = mujoco.MjData(model)
    data.qpos[3:] = [np.cos(0.4), 0.0, np.sin(0.4), 0.0]
    mujoco.mj_forward(model, data)
    rot_w = data.body(BODY).xmat.reshape(3, 3)
    force_b, torque_b = np.array([1.0, 2.0, 3.0]), np.array([0.01, 0.02, 0.03])
    data.qfrc_applied[:] = [*(rot_w @ force_b), *torque_b]
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qacc[:3], rot_w @ force_b / 0.75 + [0, 0, -9.81], atol=1e-9)
    np.testing.assert_allclose(data.qacc[3:], torque_b / PLAIN.inertia, atol=1e-9)

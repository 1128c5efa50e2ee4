"""Vehicles, their files, motors by hand, and the MuJoCo body: its mass, rotors and camera."""

import copy
import tomllib
from dataclasses import replace
from typing import Any, cast

import mujoco
import numpy as np
import pytest

import suite
from eval.effects import EFFECTS
from eval.quadrotor import vehicle_file
from eval.quadrotor.model import BODY, CAMERA, COLLIDES, compile_quadrotor, rotor_name
from eval.vehicles.vehicle import (
    MotorMap,
    command_of_thrust,
    motor_speed,
    motor_thrust,
)
from eval.vehicles.vehicle_check import check_vehicle
from tests.support.pilots import Pursuit
from tests.support.vehicles import PLAIN, drawn_effects, with_effects
from tracks.common.provenance import stamp, stamp_text
from tracks.common.toml_table import to_toml
from tracks.geometry.camera import optical_axis_b

LINEAR, WEAK = (EFFECTS[name].values for name in ("linear_drag", "weak_motor"))
DRAG = LINEAR((0.3, 0.3, 0.3))
TABLE = tomllib.loads((vehicle_file.SHIPPED / "racer5.toml").read_text())


def test_shipped_vehicles_load():
    assert {"reference", "racer5"} <= set(vehicle_file.shipped_vehicles())
    for name in vehicle_file.shipped_vehicles():
        assert vehicle_file.load_vehicle(name).name == name


def test_reference_is_what_the_tables_fly():
    vehicle = vehicle_file.load_vehicle("reference")
    weight = vehicle.mass * 9.81
    assert 4 * vehicle.rotors.thrust_max / weight == pytest.approx(3.0, rel=1e-6)
    assert vehicle.rotors.time_constant == 0.03
    assert vehicle.controller.rate_max == (6.0, 6.0, 6.0)
    assert vehicle.effects["command_delay"].delay == 0.03
    assert vehicle.effects["linear_drag"].coefficient == (0.18, 0.18, 0.72)
    assert vehicle.effects["quadratic_drag"].coefficient == (0.01, 0.01, 0.04)
    assert len(vehicle.effects) == 3


def test_every_effect_survives_a_round_trip(tmp_path):
    for seed in range(5):
        vehicle = drawn_effects(np.random.default_rng(seed))
        comment = "first\nsecond \x1b[31m\x0c\x00\x7f"
        vehicle_file.save_vehicle(vehicle, tmp_path / "v.toml", comment)
        assert vehicle_file.load_vehicle(tmp_path / "v.toml") == vehicle
    text = (tmp_path / "v.toml").read_text()
    assert f"# {stamp_text(stamp(1, None))}\n" in text and "seed" not in text


def test_a_gain_that_a_file_lacks_is_not_made_up_when_it_is_written(tmp_path):
    """With `kind` p again, a gain of 1 that nobody gave would fly."""
    path, crazyflie = tmp_path / "v.toml", vehicle_file.load_vehicle("crazyflie21")
    vehicle_file.save_vehicle(crazyflie, path)
    assert vehicle_file.load_vehicle(path) == crazyflie
    table = vehicle_file.vehicle_table(crazyflie)
    del table["controller"]["rate_gain"]
    without = vehicle_file.parse_vehicle(table)
    vehicle_file.save_vehicle(without, path)
    assert vehicle_file.load_vehicle(path) == without
    path.write_text(
        path.read_text().partition("[controller.pid_rate]")[0].replace("crazyflie", "p")
    )
    with pytest.raises(vehicle_file.VehicleFileError, match=r"\[controller\] has no 'rate_gain'"):
        vehicle_file.load_vehicle(path)


def test_arrays_are_written_as_numbers(tmp_path):
    vehicle = with_effects(linear_drag=(np.array([0.1, 0.2, 0.3]),), mass_offset=(np.array(0.1),))
    vehicle_file.save_vehicle(vehicle, tmp_path / "v.toml")
    loaded = vehicle_file.load_vehicle(tmp_path / "v.toml")
    assert loaded == with_effects(linear_drag=((0.1, 0.2, 0.3),), mass_offset=(0.1,))
    for kind in (np.float64, np.float32):
        vehicle_file.save_vehicle(replace(PLAIN, mass=kind(0.7)), tmp_path / "v.toml")
        assert vehicle_file.load_vehicle(tmp_path / "v.toml") == replace(PLAIN, mass=kind(0.7))


def test_an_impossible_vehicle_is_not_written(tmp_path):
    with pytest.raises(ValueError, match=r"linear_drag\.coefficient"):
        vehicle_file.save_vehicle(
            with_effects(linear_drag=((-1.0, 0.0, 0.0),)), tmp_path / "v.toml"
        )
    assert list(tmp_path.iterdir()) == []


REFUSED = [
    ("mass", 0.0, "mass = 0.0.*must be from"),
    ("mass", float("nan"), "mass is nan.*finite"),
    ("mass", 1e-300, "mass = 1e-300.*must be from 0.0001 to 10000 kg"),
    ("inertia", [1e-300] * 3, "inertia = .*must be from 1e-10"),
    ("name", "a\x1b[31m", "a printable text"),
    ("schema", 2, "schema is 2, allowed is 1"),
    ("controller.kind", ["px4"], r"controller\.kind is \['px4'\], allowed is 'p' or 'beta"),
    ("controller.kind", "ardupilot", r"controller\.kind is 'ardupilot'"),
    ("massa", 2, "'massa' at the top is unknown. Did you mean 'mass'"),
    (
        "inertia",
        [[0.001, 0, 0]] * 3,
        r"inertia\[0\] is \[0.001, 0, 0\], allowed is a finite number",
    ),
    ("rotors.spin", ["ccw", "cw", "ccw", "cw"], r"rotors\.spin\[0\] is 'ccw', allowed is a whole"),
    ("inertia", [0.001, 0.001, 0.003], "inertia.*sum of the other two"),
    ("rotors.spin", [1, 1, -1, 2], r"rotors\.spin.*1 .*or -1"),
    ("rotors.spin", [1, 1, 1, 1], "independently"),
    ("rotors.spin", [1, 1, 1, -1], r"rotors\.spin = .*two rotors must spin in each"),
    ("rotors.spin", [1, 1, -1, 1], r"rotors\.spin = .*two rotors must spin in each"),
    ("rotors.position", [[0.2, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [0.2, 0.1, 0]], "between"),
    ("rotors.speed_max", 1000.0, "too weak to hover with mass = 0.75 kg; a rotor"),
    ("mass", 750.0, r"too weak to hover with mass = 750 kg; a mass in grams"),
    ("rotors.time_constant", -0.1, r"rotors\.time_constant = -0\.1.*from 0"),
    ("controller.frequency", 10.0, r"controller\.frequency.*from 50"),
    ("controller.rate_gain", [20.0, 20.0, 0.0], r"controller\.rate_gain"),
    ("body", {"half_size": [0.1, 0.1, 0.0]}, r"body\.half_size"),
    ("camera", {"fov_deg": [180.0, 60.0]}, r"camera\.fov_deg"),
    ("effects", {"linear_drga": {}}, "linear_drga.*Did you mean 'linear_drag'"),
    ("effects", {"linear_drag": {"coefficient": 0.3}}, r"linear_drag\.coefficient.*list of 3"),
    ("effects", {"linear_drag": {"coefficient": [0.1, 0.1, -0.1]}}, "from 0 to 5 1/s"),
    ("effects", {"battery_sag": {}}, "give rate or per_volt"),
    ("effects", {"gusts": {"intensity": 1.0}}, r"\[effects.gusts\] has no 'length'; add it"),
    ("effects", {"mass_offset": {"offset": -0.7}}, r"mass_offset\.offset = -0\.7.*-0\.375"),
    ("effects", {"weak_motor": {"index": 5, "scale": 0.9}}, "weak_motor.*from 1 to 4"),
    ("effects", {"weak_motor": {"index": [1, 1], "scale": [0.9, 0.9]}}, "different"),
    ("effects", {"weak_motor": {"index": [1], "scale": 0.9}}, "both numbers or both lists"),
    ("effects", {"weak_motor": {"scale": 0.9}}, "index: missing; give index = 2 and scale = 0.9,"),
    ("effects", {"weak_motor": {"scale": [1.0, 0.9]}}, "one scale for each index"),
    ("effects", {"weak_motor": {"index": 1, "scale": 10**400}}, "scale = 1000.*finite number"),
    ("effects", {"weak_motor": {"index": 1, "scale": -0.5}}, "from 0 to 1.5$"),
]


@pytest.mark.parametrize(("key", "value", "message"), REFUSED)
def test_a_bad_file_is_refused_by_key_and_value(tmp_path, key, value, message):
    table = copy.deepcopy(TABLE)
    *sections, last = key.split(".")
    inner = table
    for section in sections:
        inner = inner[section]
    inner[last] = value
    path = tmp_path / "bad.toml"
    path.write_text(to_toml(table))
    with pytest.raises(vehicle_file.VehicleFileError, match=message) as refusal:
        vehicle_file.load_vehicle(path)
    assert str(path) in str(refusal.value)


def test_unreadable_files_are_refused(tmp_path):
    with pytest.raises(vehicle_file.VehicleFileError, match="no such file"):
        vehicle_file.load_vehicle(tmp_path / "none.toml")
    with pytest.raises(vehicle_file.VehicleFileError, match="cannot be read"):
        vehicle_file.load_vehicle(tmp_path)
    with pytest.raises(ValueError, match="Did you mean 'racer5'"):
        vehicle_file.load_vehicle("racer")


@pytest.mark.parametrize(
    ("effect", "drag", "said"),
    [
        ("linear_dragg", 0.3, "unknown effect 'linear_dragg'. Did you mean 'linear_drag'"),
        ("linear_drag", -0.3, "must be from 0 to 5 1/s"),
        ("linear_drag", np.nan, "is nan, allowed is a finite number"),
    ],
)
def test_a_vehicle_of_a_program_is_checked_as_a_file_is(tmp_path, effect, drag, said):
    values = EFFECTS["linear_drag"].values((drag,) * 3)
    vehicle = replace(PLAIN, effects={effect: values})
    with pytest.raises(ValueError, match=said):
        suite.save_vehicle(vehicle, tmp_path / "it.toml")
    with pytest.raises(ValueError, match=said):
        suite.evaluate_policy(Pursuit(), trials=1, vehicle=vehicle)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("part", "value", "said"),
    [
        ("rotors", None, "rotors is None, allowed is a Rotors"),
        ("camera", 90.0, "camera is 90.0, allowed is a Camera"),
        ("motors", (1.0, 2.0), "motors is .*, allowed is a MotorMap or None"),
        ("effects", ["linear_drag"], "effects is .*, allowed is values by name of the effect"),
        ("effects", {"linear_drag": {"coefficient": (0.3, 0.3, 0.3)}}, "effects.linear_drag is {"),
        ("effects", {"linear_drag": 0.3}, r"allowed is EFFECTS\['linear_drag'\].values\(coeff"),
        # Its coefficients have another unit.
        ("effects", {"quadratic_drag": DRAG}, "effects.quadratic_drag is LinearDrag"),
        ("controller", replace(PLAIN.controller, kind="pid"), "controller.kind is 'pid', allowed"),
        ("controller", replace(PLAIN.controller, kind="px4"), "controller.settings is None, allo"),
        ("controller.kind", [], r"controller.kind is \[\], allowed is a text"),
        ("mass", "0.75", "mass is '0.75', allowed is a finite number"),
        ("inertia", 0.003, "inertia is 0.003, allowed is a list of 3 numbers"),
        ("rotors.spin", None, "rotors.spin is None, allowed is a list of 4 numbers"),
        ("rotors.position", (0.1,) * 4, r"rotors.position\[0\] is 0.1, allowed is a list of 3"),
        ("rotors.speed_max", "2100", "rotors.speed_max is '2100', allowed is a finite number"),
        ("body.half_size", {"x": 0.1}, "body.half_size is {'x': 0.1}, allowed is a list of 3"),
        ("camera.fov_deg", 90.0, "camera.fov_deg is 90.0, allowed is a list of 2 numbers"),
        ("camera.width", "32", "camera.width is '32', allowed is a whole number"),
        ("motors", MotorMap((1.0, 5.0), cast(Any, None)), "motors.voltage is None, allowed is a f"),
        ("effects", {"linear_drag": LINEAR(0.3)}, "linear_drag.coefficient is 0.3, allowed is a"),
        ("effects", {"weak_motor": WEAK((1.0,) * 3)}, r"effects.weak_motor is Weak.*\(1.0, 1.0, 1"),
    ],
)
def test_a_part_of_another_type_is_refused_by_its_name(tmp_path, part, value, said):
    part, _, key = part.partition(".")
    value = replace(getattr(PLAIN, part), **{key: value}) if key else value
    vehicle = replace(PLAIN, **{part: value})
    with pytest.raises(ValueError, match=said):
        vehicle_file.save_vehicle(vehicle, tmp_path / "v.toml")
    with pytest.raises(ValueError, match=said):
        suite.evaluate_policy(Pursuit(), track="zigzag", trials=1, vehicle=vehicle)
    assert not list(tmp_path.iterdir())


def test_a_weak_motor_has_an_index_or_a_scale_for_each_rotor():
    every, one = (
        vehicle_file.parse_vehicle({**TABLE, "effects": {"weak_motor": table}})
        for table in ({"scale": [1.0, 0.9, 1.0, 1.0]}, {"index": 2, "scale": 0.9})
    )
    assert every == one and every.effects["weak_motor"].scale == (1.0, 0.9, 1.0, 1.0)


def test_a_vehicle_that_flies_passes_and_is_a_key():
    check_vehicle(PLAIN)
    assert PLAIN.rotors.thrust_max == pytest.approx(7.056)
    assert hash(PLAIN.rotors) == hash(replace(PLAIN.rotors))
    # A flat body has the largest moment exactly at the sum of the other two.
    check_vehicle(replace(PLAIN, inertia=(0.1, 0.2, 0.1 + 0.2)))


MAP = MotorMap(thrust=(0.2, 0.6), voltage=4.0)


def test_a_thrust_has_one_command():
    command = np.array([0.0, 0.3, 1.0])
    for curve in ((0.2, 0.6), (0.0, 0.8), (0.5, 0.0)):
        thrust = curve[0] * command + curve[1] * command**2
        np.testing.assert_allclose(command_of_thrust(curve, thrust), command, atol=1e-9)


def test_thrust_goes_with_command_and_voltage_and_speed_with_the_thrust():
    """u = 0.5 x 3/4 = 0.375; T = 0.2 x 0.375 + 0.6 x 0.140625 = 0.159375 N."""
    vehicle, command = replace(PLAIN, motors=MAP), np.full((2, 4), 0.5)
    speed = motor_speed(vehicle, command, np.array([3.0, 4.0]))
    thrust = vehicle.rotors.thrust_coefficient * speed**2
    np.testing.assert_allclose(thrust.T, [[0.159375, 0.25]] * 4)
    np.testing.assert_allclose(motor_thrust(MAP, command), 0.25)
    made_up_for = replace(MAP, voltage_exponent=0.0)
    np.testing.assert_allclose(motor_thrust(made_up_for, command, np.array([3.0, 4.0])), 0.25)
    with pytest.raises(ValueError, match=r"no \[motors\]"):
        motor_speed(PLAIN, np.zeros((1, 4)))


def test_motors_come_back_from_a_file_and_wrong_ones_are_refused():
    crazyflie = vehicle_file.load_vehicle("crazyflie21")
    table = vehicle_file.vehicle_table(crazyflie)
    assert vehicle_file.parse_vehicle(table) == crazyflie
    for motors, reason in (
        ({"thrust": [0.1, 0.1]}, r"\[motors\] has no 'voltage'"),
        (
            {**table["motors"], "thrust": [0.0, 0.05]},
            r"motors.thrust = .*too weak to hover .* gives 0.05",
        ),
        ({"thrust": [0.1, -0.1], "voltage": 4.0}, "must grow"),
        ({"thrust": [0.1, 0.1], "voltage": 4.0, "volts": 1.0}, "Did you mean 'voltage'"),
    ):
        with pytest.raises(ValueError, match=reason):
            vehicle_file.parse_vehicle({**table, "motors": motors})


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
    assert [model.actuator(i).name for i in range(model.nu)] == [rotor_name(i) for i in range(4)]
    np.testing.assert_allclose(model.actuator_ctrlrange, [[0.0, PLAIN.rotors.thrust_max]] * 4)


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


def test_only_the_box_collides_and_visuals_do_not_block_rays():
    model = compiled(PLAIN, ground=True)
    data = mujoco.MjData(model)
    level, on_its_side = [1.0, 0.0, 0.0, 0.0], [np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0, 0.0]
    # On its side the arms would touch first, at 0.1 m.
    for height, quat, touches in ((0.026, level, 0), (0.066, on_its_side, 0), (0.024, level, 1)):
        data.qpos[2:] = [height, *quat]
        mujoco.mj_forward(model, data)
        assert (data.ncon > 0) == touches
    assert {model.geom(g).name for c in data.contact for g in c.geom} == {"", COLLIDES}
    data.qpos[2] = 3.0
    mujoco.mj_forward(model, data)
    hit, distance = np.zeros(1, np.int32), np.zeros(1)
    above, down = np.array([0.075, 0.1, 3.5]), np.array([0.0, 0, -1])  # above a rotor disk
    mujoco.mj_multiRay(model, data, above, down, None, True, -1, hit, distance, None, 1, 10.0)
    assert distance[0] == pytest.approx(3.5)


def test_camera_looks_where_the_vehicle_file_says():
    model = compiled(PLAIN)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    axes = data.cam(CAMERA).xmat.reshape(3, 3)
    np.testing.assert_allclose(-axes[:, 2], optical_axis_b(PLAIN.camera), atol=1e-12)
    np.testing.assert_allclose(axes[:, 0], [0.0, -1.0, 0.0], atol=1e-12)
    assert model.camera(CAMERA).fovy[0] == 63.8

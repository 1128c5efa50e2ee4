"""Vehicles and their files: shipped ones, round trips, refusals, and motors by hand."""

import copy
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from eval.quadrotor.vehicle_file import (
    SHIPPED,
    VehicleFileError,
    load_vehicle,
    parse_vehicle,
    save_vehicle,
    shipped_vehicles,
    vehicle_table,
)
from eval.vehicles.vehicle import MotorMap, command_of_thrust, motor_speed, motor_thrust
from eval.vehicles.vehicle_check import check_vehicle
from tests.support.vehicles import PLAIN, drawn_effects, with_effects
from tracks.common.toml_table import to_toml

TABLE = tomllib.loads((SHIPPED / "racer5.toml").read_text())


def test_shipped_vehicles_load():
    assert {"reference", "racer5"} <= set(shipped_vehicles())
    for name in shipped_vehicles():
        assert load_vehicle(name).name == name


def test_reference_is_what_the_tables_fly():
    vehicle = load_vehicle("reference")
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
        save_vehicle(vehicle, tmp_path / "v.toml", comment="first line\nsecond line")
        assert load_vehicle(tmp_path / "v.toml") == vehicle


def test_arrays_are_written_as_numbers(tmp_path):
    vehicle = with_effects(linear_drag=(np.array([0.1, 0.2, 0.3]),), mass_offset=(np.array(0.1),))
    save_vehicle(vehicle, tmp_path / "v.toml")
    loaded = load_vehicle(tmp_path / "v.toml")
    assert loaded == with_effects(linear_drag=((0.1, 0.2, 0.3),), mass_offset=(0.1,))
    save_vehicle(replace(PLAIN, mass=np.float64(0.7)), tmp_path / "v.toml")
    assert load_vehicle(tmp_path / "v.toml") == replace(PLAIN, mass=0.7)


def test_an_impossible_vehicle_is_not_written(tmp_path):
    with pytest.raises(ValueError, match=r"linear_drag\.coefficient"):
        save_vehicle(with_effects(linear_drag=((-1.0, 0.0, 0.0),)), tmp_path / "v.toml")
    assert list(tmp_path.iterdir()) == []


def test_weak_motor_takes_one_or_several():
    table = copy.deepcopy(TABLE)
    table["effects"] = {"weak_motor": {"index": 3, "scale": 0.9}}
    assert parse_vehicle(table).effects["weak_motor"].scale == (1.0, 1.0, 0.9, 1.0)
    table["effects"] = {"weak_motor": {"index": [4, 1], "scale": [0.8, 0.95]}}
    vehicle = parse_vehicle(table)
    assert vehicle.effects["weak_motor"].scale == (0.95, 1.0, 1.0, 0.8)
    assert parse_vehicle(vehicle_table(vehicle)) == vehicle


def test_motors_that_cannot_hover_are_refused_where_a_firmware_drives_them():
    table = vehicle_table(load_vehicle("crazyflie21"))
    table["motors"]["thrust"] = [0.0, 0.05]
    with pytest.raises(
        ValueError, match=r"motors.thrust = .*too weak to hover; a rotor gives 0.05"
    ):
        parse_vehicle(table)


REFUSED = [
    ("mass", 0.0, "mass = 0.0.*must be from"),
    ("mass", float("nan"), "mass is nan.*finite"),
    ("schema", 2, "schema is 2, allowed is 1"),
    (
        "controller.kind",
        ["px4"],
        r"controller\.kind is \['px4'\], allowed is 'p' or 'betaflight' or ",
    ),
    ("massa", 2, "'massa' at the top is unknown. Did you mean 'mass'"),
    ("inertia", [0.001, 0.001, 0.003], "inertia.*sum of the other two"),
    ("inertia", [0.001, -0.001, 0.001], "inertia.*must be from"),
    ("rotors.spin", [1, 1, -1, 2], r"rotors\.spin.*1 .*or -1"),
    ("rotors.spin", [1, 1, 1, 1], "independently"),
    ("rotors.spin", [1, -1, -1, 1], "independently"),
    ("rotors.position", [[0.2, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [0.2, 0.1, 0]], "between"),
    ("rotors.speed_max", 1000.0, "too weak to hover"),
    ("rotors.time_constant", -0.1, r"rotors\.time_constant = -0\.1.*from 0"),
    ("rotors.thrust_coefficient", 0.0, r"rotors\.thrust_coefficient"),
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
    ("effects", {"weak_motor": {"index": 1, "scale": "low"}}, "must be a finite number"),
    ("effects", {"weak_motor": {"index": 1, "scale": 10**400}}, "scale = 1000.*finite number"),
    ("effects", {"weak_motor": {"index": 1, "scale": -0.5}}, "from 0 to 1.5"),
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
    with pytest.raises(VehicleFileError, match=message) as refusal:
        load_vehicle(path)
    assert str(path) in str(refusal.value)


def test_unreadable_files_are_refused(tmp_path):
    with pytest.raises(VehicleFileError, match="no such file"):
        load_vehicle(tmp_path / "none.toml")
    with pytest.raises(VehicleFileError, match="cannot be read"):
        load_vehicle(tmp_path)
    path = tmp_path / "bad.toml"
    path.write_text("mass = = 3")
    with pytest.raises(VehicleFileError, match="is not TOML"):
        load_vehicle(path)
    path.write_text("mass = " + "9" * 400)
    with pytest.raises(VehicleFileError, match="mass|has no 'name'"):
        load_vehicle(path)
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(VehicleFileError, match="UTF-16"):
        load_vehicle(path)
    path.write_bytes(b"name = \xe9")
    with pytest.raises(VehicleFileError, match="is not TOML"):
        load_vehicle(path)
    with pytest.raises(ValueError, match="Did you mean 'racer5'"):
        load_vehicle("racer")


def test_a_vehicle_that_flies_passes_and_is_a_key():
    check_vehicle(PLAIN)
    assert PLAIN.rotors.thrust_max == pytest.approx(7.056)
    assert hash(PLAIN.rotors) == hash(replace(PLAIN.rotors))
    # A flat body has the largest moment exactly at the sum of the other two.
    check_vehicle(replace(PLAIN, inertia=(0.1, 0.2, 0.1 + 0.2)))


@pytest.mark.parametrize(
    ("vehicle", "message"),
    [
        (replace(PLAIN, mass=1e-300), "mass = 1e-300: must be from 0.0001 to 10000 kg"),
        (replace(PLAIN, inertia=(1e-300,) * 3), "inertia = .*must be from 1e-10"),
        (
            replace(PLAIN, rotors=replace(PLAIN.rotors, speed_max=1070.0)),
            "too weak to hover; a rotor gives 1.83 N and 1.84 N",
        ),
    ],
)
def test_what_cannot_fly_is_refused(vehicle, message):
    with pytest.raises(ValueError, match=message):
        check_vehicle(vehicle)


MAP = MotorMap(thrust=(0.2, 0.6), voltage=4.0)


def test_thrust_goes_with_command_and_voltage():
    """u = 0.5 x 3/4 = 0.375; T = 0.2 x 0.375 + 0.6 x 0.140625 = 0.159375 N."""
    command = np.full((1, 4), 0.5)
    np.testing.assert_allclose(motor_thrust(MAP, command, np.array([3.0])), 0.159375)
    np.testing.assert_allclose(motor_thrust(MAP, command), 0.25)
    made_up_for = replace(MAP, voltage_exponent=0.0)
    np.testing.assert_allclose(motor_thrust(made_up_for, command, np.array([3.0])), 0.25)


def test_a_thrust_has_one_command():
    command = np.array([0.0, 0.3, 1.0])
    for curve in ((0.2, 0.6), (0.0, 0.8), (0.5, 0.0)):
        thrust = curve[0] * command + curve[1] * command**2
        np.testing.assert_allclose(command_of_thrust(curve, thrust), command, atol=1e-9)


def test_speed_is_that_of_the_thrust():
    vehicle = replace(PLAIN, motors=MAP)
    speed = motor_speed(vehicle, np.full((2, 4), 0.5), np.array([3.0, 4.0]))
    thrust = vehicle.rotors.thrust_coefficient * speed**2
    np.testing.assert_allclose(thrust[:, 0], [0.159375, 0.25])
    with pytest.raises(ValueError, match=r"no \[motors\]"):
        motor_speed(PLAIN, np.zeros((1, 4)))


def test_motors_come_back_from_a_file_and_wrong_ones_are_refused():
    crazyflie = load_vehicle("crazyflie21")
    table = vehicle_table(crazyflie)
    assert parse_vehicle(table) == crazyflie
    for motors, reason in (
        ({"thrust": [0.1, 0.1]}, r"\[motors\] has no 'voltage'"),
        ({"thrust": [0.1, -0.1], "voltage": 4.0}, "must grow"),
        ({"thrust": [0.1, 0.1], "voltage": 4.0, "volts": 1.0}, "Did you mean 'voltage'"),
    ):
        with pytest.raises(ValueError, match=reason):
            parse_vehicle({**table, "motors": motors})

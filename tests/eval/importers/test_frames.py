"""Frames and units against what they are; thrust, motors and set points become commands."""

from dataclasses import replace

import numpy as np
import pytest

from eval.importers.commands import (
    SHARE,
    SHIPPED_ORDER,
    order_motors,
    rates_wanted,
    thrust_command,
)
from eval.importers.formats import ardupilot, betaflight
from eval.importers.frames import (
    attitude,
    body_vector,
    conjugate,
    from_euler,
    multiply,
    rotate,
    rotation_vector,
    world_vector,
)
from eval.importers.mapping_file import UNITS
from eval.importers.options import ImportOptions
from eval.importers.rows import rows_at
from eval.importers.signals import Recording, Signal
from eval.logs.faults.reading import TIMES
from eval.quadrotor.loops import KINDS, loop_of, start, update
from eval.vehicles.vehicle import MotorMap, command_of_thrust
from tests.support.vehicles import PLAIN

ROOT_HALF = np.sqrt(0.5)
LEFT_TURN = np.array([ROOT_HALF, 0.0, 0.0, ROOT_HALF])
"""A quarter turn about z: forward becomes left."""
NOSE_UP = np.array([ROOT_HALF, 0.0, -ROOT_HALF, 0.0])
"""A quarter turn about -y: forward becomes up."""


def test_axes_of_worlds_and_bodies():
    vector = np.array([1.0, 2.0, 3.0])
    for world, wanted in (("z-up", [1, 2, 3]), ("ned", [1, -2, -3]), ("y-up", [1, -3, 2])):
        np.testing.assert_allclose(world_vector(vector[None], world), [wanted], atol=1e-15)
    np.testing.assert_array_equal(body_vector(vector, "frd"), [1, -2, -3])
    np.testing.assert_array_equal(body_vector(vector, "flu"), vector)


def test_turns_follow_one_another_from_right_to_left():
    forward = np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(rotate(LEFT_TURN, forward), [0, 1, 0], atol=1e-15)
    # Nose up first, which the turn about the vertical then leaves up.
    both = multiply(LEFT_TURN, NOSE_UP)
    np.testing.assert_allclose(rotate(both, forward), [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(rotate(multiply(NOSE_UP, LEFT_TURN), forward), [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(multiply(both, conjugate(both)), [1, 0, 0, 0], atol=1e-15)


def test_a_turn_to_the_right_of_a_forward_right_down_body_is_one_to_the_right_of_ours():
    level = np.array([1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(attitude(level, "ned", "frd"), level, atol=1e-15)
    # About down, forward turns right: in our axes that is the left turn's inverse.
    np.testing.assert_allclose(attitude(LEFT_TURN, "ned", "frd"), conjugate(LEFT_TURN), atol=1e-15)


def test_euler_angles_and_rotation_vectors():
    quarter = 0.5 * np.pi
    np.testing.assert_allclose(from_euler(np.array([0.0, 0.0, quarter])), LEFT_TURN, atol=1e-15)
    yaw_then_pitch = from_euler(np.array([0.0, -quarter, quarter]))
    np.testing.assert_allclose(yaw_then_pitch, multiply(LEFT_TURN, NOSE_UP), atol=1e-15)
    for sign in (1.0, -1.0):  # the same attitude, told with either sign
        np.testing.assert_allclose(rotation_vector(sign * LEFT_TURN), [0, 0, quarter], atol=1e-15)
    np.testing.assert_array_equal(rotation_vector(np.array([1.0, 0.0, 0.0, 0.0])), np.zeros(3))


TURN, G = 6.283185307179586, 9.81
ONE = {
    "s": 1.0, "ms": 0.001, "us": 0.000001, "ns": 0.000000001,
    "m": 1.0, "cm": 0.01, "mm": 0.001, "m/s": 1.0, "cm/s": 0.01, "mm/s": 0.001,
    "rad": 1.0, "deg": TURN / 360, "rad/s": 1.0, "deg/s": TURN / 360, "mrad/s": 0.001,
    "m/s^2": 1.0, "m/s/s": 1.0, "g": G, "rpm": TURN / 60, "Hz": TURN,
    "1": 1.0, "%": 0.01, "65535": 1 / 65535, "N": 1.0, "N m": 1.0, "V": 1.0, "mV": 0.001,
}  # fmt: skip
"""One of each unit in SI; `65535` is the full scale of a motor command."""


def test_every_unit_is_what_it_says():
    """Of mappings, of checks, and of Betaflight, where no unit in a header is a raw one."""
    raw = [
        (betaflight._TIME, 1e-6), (betaflight._ROTATION, TURN / 360),
        (betaflight._ACCELERATION, G / 2048), (betaflight._VOLT, 0.01),
    ]  # fmt: skip
    for units, bare in [*((units, None) for units in (*UNITS.values(), TIMES)), *raw]:
        wanted = {name: ONE[name] if name else bare for name in units}
        assert units == pytest.approx(wanted, rel=1e-12)


def test_a_column_is_in_the_unit_of_its_header(tmp_path):
    path = tmp_path / "log.csv"
    names = "loopIteration,time (us),vbatLatest (mV),accSmooth[2] (m/s/s)"
    path.write_text(f"{names}\n0,0,16100,9.8\n1,500,16000,9.7\n")
    box = betaflight.Blackbox(path)
    acc = box.values(["accSmooth[2]"], betaflight._ACCELERATION)
    np.testing.assert_allclose(acc[:, 0], [9.8, 9.7])
    np.testing.assert_allclose(box.values(["vbatLatest"], betaflight._VOLT)[:, 0], [16.1, 16.0])
    np.testing.assert_allclose(box.values(["time"], betaflight._TIME)[:, 0], [0.0, 5e-4])


@pytest.mark.parametrize(
    ("header", "raw", "share"),
    [
        ((158, 2047), 1047.5, 0.5),  # DShot with 5.5 % of idle
        ((158, 1647), 2047.0, 1.0),  # and a motor_output_limit of 80 %
        (None, 1047.5, 0.5),
        ((1070, 2000), 1500.0, 0.5),  # pulses, which begin at minthrottle
        (None, 1500.0, 0.5),
    ],
)
def test_motor_outputs_are_shares_of_their_protocols_range(header, raw, share):
    """The vehicle file's [motors] and loops count commands from a motor's stop, not its idle."""
    least = 158.0 if raw != 1500.0 else 1070.0
    box = betaflight.Blackbox.__new__(betaflight.Blackbox)
    box.name, box.findings, box.header = "log", [], {"motorOutput": header} if header else {}
    box.columns = {f"motor[{k}]": np.array([least, raw]) for k in range(4)}
    box.units = {name: (name, "") for name in box.columns}
    np.testing.assert_allclose(betaflight._outputs(box)["pwm"][1], share, atol=1e-9)


@pytest.mark.parametrize(
    ("motors", "sticks", "pulses"),
    [
        ((), {}, (1000.0, 2000.0)),
        ((1100.0, 1900.0), {"RC3_MIN": 990.0}, (1100.0, 1900.0)),
        ((0.0, 0.0), {"RC3_MIN": 1100.0, "RC3_MAX": 1940.0}, (1100.0, 1940.0)),  # Copter 3 and 4.0
        ((0.0, 1900.0), {"RCMAP_THROTTLE": 2.0, "RC2_MAX": 1950.0}, (1000.0, 1950.0)),
        ((1900.0, 1100.0), {"RC3_MIN": 2000.0}, (1000.0, 2000.0)),
    ],
)
def test_pulses_of_ardupilot_are_of_the_motors_else_of_the_sticks_range(motors, sticks, pulses):
    parameters = dict(zip(("MOT_PWM_MIN", "MOT_PWM_MAX"), motors, strict=False)) | sticks
    assert ardupilot._pulse_range(parameters) == pulses


def thrust_rows(felt=None, count=200):
    """Rows with a throttle from 0.2 to 0.8, and where `felt` is given an accelerometer."""
    throttle = np.linspace(0.2, 0.8, count)
    found = {"throttle": throttle[:, None]}
    if felt is not None:
        found["acc"] = felt * throttle[:, None] * np.array([0.0, 0.0, 1.0])
    return found


@pytest.mark.parametrize(
    ("felt", "options", "full", "by"),
    [
        (25.0, ImportOptions(full_thrust=20.0, vehicle=PLAIN), 20.0, "as given"),
        # Four rotors of 1.6e-6 N s^2 at 2100 rad/s on 0.75 kg.
        (37.632, ImportOptions(vehicle=PLAIN), 37.632, "by the vehicle file"),
        (25.0, ImportOptions(), 25.0, "by the accelerometer"),
    ],
)
def test_full_throttle_is_what_is_told_or_built_or_felt(felt, options, full, by):
    found = thrust_rows(felt)
    (finding,) = thrust_command(found, options)
    np.testing.assert_allclose(found["cmd_thrust"], full * found["throttle"], rtol=1e-12)
    assert finding.status == "note" and by in finding.evidence


@pytest.mark.parametrize("found", [thrust_rows(), thrust_rows(25.0, count=50)])
def test_where_nothing_tells_the_scale_thrust_is_left_out_and_one_that_is_there_stays(found):
    (finding,) = thrust_command(found, ImportOptions())
    assert "cmd_thrust" not in found and finding.status == "doubt"
    assert "give --vehicle FILE or --full-thrust" in finding.evidence
    found["cmd_thrust"] = np.ones((len(found["throttle"]), 1))
    assert thrust_command(found, ImportOptions(full_thrust=20.0)) == []
    assert (found["cmd_thrust"] == 1.0).all()


def test_a_throttle_goes_through_the_vehicles_motors_with_the_battery():
    """u = 0.5 x 3/4: 4 x 0.159375 N over the mass; see test_vehicle_file.py."""
    vehicle = replace(PLAIN, motors=MotorMap((0.2, 0.6), 4.0))
    rows = {"throttle": np.full((3, 1), 0.5), "voltage": np.full((3, 1), 3.0)}
    findings = thrust_command(rows, ImportOptions(vehicle=vehicle))
    np.testing.assert_allclose(rows["cmd_thrust"], 4 * 0.159375 / vehicle.mass)
    assert "with the battery's voltage" in findings[0].evidence


def test_a_thrust_that_the_firmware_makes_linear_does_not_go_through_the_motors():
    vehicle = replace(PLAIN, motors=MotorMap((0.2, 0.6), 4.0))
    rows = {SHARE: np.full((3, 1), 0.5), "voltage": np.full((3, 1), 3.0)}
    thrust_command(rows, ImportOptions(vehicle=vehicle))
    np.testing.assert_allclose(rows["cmd_thrust"], 0.5 * vehicle.full_thrust)


@pytest.mark.parametrize(
    ("kind", "settings", "throttle_of"),
    [
        ("betaflight", {"dshot_idle_value": 550.0}, lambda u: (u - 0.055) / 0.945),
        ("px4", {"THR_MDL_FAC": 0.3}, lambda u: 0.3 * u**2 + 0.7 * u),
        ("px4", {"THR_MDL_FAC": 0.0}, lambda u: u),
        ("crazyflie", {}, lambda u: u),
    ],
)
def test_a_firmwares_throttle_gives_the_thrust_of_its_motor_commands(kind, settings, throttle_of):
    """The thrust that the simulated loop makes of the motor commands that it gives at rest."""
    controller = replace(PLAIN.controller, kind=kind, settings=KINDS[kind].Settings(**settings))
    vehicle = replace(PLAIN, controller=controller, motors=MotorMap((0.5, 7.0), 4.0))
    force, loop = np.array([4.0, 9.0, 15.0]), loop_of(vehicle)
    still, each = np.zeros((3, 3)), np.ones((3, 3))
    _, thrust = update(loop, start(loop, (3,), np), force, still, still, 0.002, each)
    np.testing.assert_allclose(thrust, np.repeat(force[:, None] / 4.0, 4, axis=1), rtol=1e-9)
    command = command_of_thrust(vehicle.motors.thrust, thrust[:, :1])
    rows = {"throttle": throttle_of(command)}
    thrust_command(rows, ImportOptions(vehicle=vehicle))
    np.testing.assert_allclose(rows["cmd_thrust"][:, 0], force / PLAIN.mass, rtol=1e-9)


def motor_rows():
    return {"motor": np.array([[10.0, 20.0, 30.0, 40.0]]), "motor_cmd": np.array([[1.0, 2, 3, 4]])}


def test_places_in_any_unit_set_the_order_the_vehicles_own_before_the_shipped_ones():
    found = motor_rows()
    assert order_motors(found, None, None) == [] == order_motors({}, SHIPPED_ORDER, None)
    np.testing.assert_array_equal(found["motor"], [[10, 20, 30, 40]])
    backwards = tuple((90.0 * x, 70.0 * y) for x, y in reversed(SHIPPED_ORDER))
    hubs = PLAIN.rotors.position
    turned = replace(PLAIN.rotors, position=(hubs[1], hubs[2], hubs[3], hubs[0]))
    for places, vehicle, order, words in (
        (backwards, None, [4, 3, 2, 1], "shipped vehicles: the file's 4, 3, 2, 1"),
        (SHIPPED_ORDER, replace(PLAIN, rotors=turned), [2, 3, 4, 1], "vehicle 'plain'"),
    ):
        found = motor_rows()
        (finding,) = order_motors(found, places, vehicle)
        np.testing.assert_array_equal(found["motor_cmd"], [order])
        np.testing.assert_array_equal(found["motor"], 10 * found["motor_cmd"])
        assert words in finding.evidence


def set_points(angle):
    half = 0.5 * angle
    return {
        "quat": np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        "cmd_quat": np.tile([np.cos(half), 0.0, np.sin(half), 0.0], (2, 1)),
    }


def test_set_points_are_the_error_times_the_gain_within_the_limit_where_a_vehicle_says_it():
    for angle, wanted in (
        (0.1, 0.1 * PLAIN.controller.attitude_gain[1]),
        (3.0, PLAIN.controller.rate_max[1]),
    ):
        given = set_points(angle)
        rates_wanted(given, PLAIN)
        np.testing.assert_allclose(given["cmd_rate"], [[0.0, wanted, 0.0]] * 2, atol=1e-12)
    given = set_points(0.1)
    assert rates_wanted(given, None)[0].status == "doubt"
    assert set(given) == {"quat"}


def test_set_points_whose_sign_flips_are_one_attitude():
    times = np.arange(0.0, 1.0, 0.004)
    quat = np.tile([0.8, 0.6, 0.0, 0.0], (len(times), 1))
    turning = quat * np.where(np.arange(len(times)) % 3 == 0, -1.0, 1.0)[:, None]
    signals = {"quat": Signal(times, quat), "cmd_quat": Signal(times, turning)}
    rows = rows_at(Recording("log", signals), times[::2])
    np.testing.assert_allclose(np.abs(rows["cmd_quat"]), quat[::2], atol=1e-12)

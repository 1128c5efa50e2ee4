"""Frames of logs against turns worked by hand, and every unit against what one of it is."""

import numpy as np
import pytest

from eval.importers.formats import betaflight
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
from eval.logs.faults.reading import TIMES

ROOT_HALF = np.sqrt(0.5)

LEFT_TURN = np.array([ROOT_HALF, 0.0, 0.0, ROOT_HALF])
"""A quarter turn about z: forward becomes left."""

NOSE_UP = np.array([ROOT_HALF, 0.0, -ROOT_HALF, 0.0])
"""A quarter turn about -y: forward becomes up."""


@pytest.mark.parametrize(
    ("world", "expected"), [("z-up", [1, 2, 3]), ("ned", [1, -2, -3]), ("y-up", [1, -3, 2])]
)
def test_world_axes(world, expected):
    found = world_vector(np.array([[1.0, 2.0, 3.0]]), world)
    np.testing.assert_allclose(found, [expected], atol=1e-15)


def test_body_axes():
    vector = np.array([1.0, 2.0, 3.0])
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
    "m/s^2": 1.0, "m/s2": 1.0, "g": G, "rpm": TURN / 60, "Hz": TURN,
    "1": 1.0, "%": 0.01, "65535": 1 / 65535, "N": 1.0, "N m": 1.0, "V": 1.0, "mV": 0.001,
}  # fmt: skip
"""One of each unit in SI; `65535` is the full scale of a motor command."""


def test_every_unit_of_a_mapping_is_what_it_says():
    for signal, units in UNITS.items():
        assert units == pytest.approx({name: ONE[name] for name in units}, rel=1e-12), signal


def test_every_unit_that_a_check_tries_is_what_it_says():
    assert TIMES == pytest.approx({name: ONE[name] for name in TIMES}, rel=1e-12)


@pytest.mark.parametrize(
    ("table", "raw"),
    [
        (betaflight._TIME, 1e-6), (betaflight._ROTATION, TURN / 360),
        (betaflight._ACCELERATION, G / 2048), (betaflight._VOLT, 0.01),
    ],
)  # fmt: skip
def test_every_unit_of_betaflight_is_what_it_says(table, raw):
    """Where the header says no unit it is `raw`."""
    assert table == pytest.approx({"": raw, **{n: ONE[n] for n in table if n}}, rel=1e-12)


def test_a_column_is_in_the_unit_of_its_header(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("loopIteration,time (us),vbatLatest (mV)\n0,0,16100\n1,500,16000\n")
    box = betaflight.Blackbox(path)
    np.testing.assert_allclose(box.values(["vbatLatest"], betaflight._VOLT)[:, 0], [16.1, 16.0])
    np.testing.assert_allclose(box.values(["time"], betaflight._TIME)[:, 0], [0.0, 5e-4])

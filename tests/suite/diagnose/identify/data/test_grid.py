"""Windows are exact on lines and parabolas; commands hold, holes stay holes."""

import numpy as np
import pytest

from eval.logs.flight_log import FlightLog
from suite.diagnose.identify.grid import (
    ROTOR_NOISE,
    STEP_S,
    FlightGrid,
    grid_of,
)


def grid(values):
    time_s = STEP_S * np.arange(len(values))
    return FlightGrid("made", time_s, {"x": np.asarray(values, dtype=float)[:, None]})


def test_bumps_are_exact_on_lines_and_parabolas():
    time_s = STEP_S * np.arange(500)
    flight = grid(3.0 + 2.0 * time_s + 5.0 * time_s**2)
    values = flight.signals["x"]
    form, path = (flight.form(0.2, ("x",), slope) for slope in (False, True))
    assert form.middle_s[0] >= 0.4
    slope = (form.change @ values)[:, 0]
    np.testing.assert_allclose(slope, 2.0 + 10.0 * form.middle_s, rtol=1e-3)
    np.testing.assert_allclose(path.change @ values, 10.0, rtol=1e-3)
    constant = np.full((500, 1), 7.0)
    np.testing.assert_allclose(path.mean @ constant, 0.0, atol=1e-9)
    np.testing.assert_allclose(form.mean @ constant, 7.0)
    np.testing.assert_allclose(path.mean @ time_s, 1.0, rtol=1e-3)


def test_no_bump_lies_over_a_hole():
    values = np.ones(500)
    values[250] = np.nan
    for middle_s in grid(values).form(0.2, ("x",)).middle_s:
        assert abs(middle_s - 1.0) > 0.095


def test_commands_hold_until_the_next_row_and_measurements_are_joined():
    time_s = np.arange(0.0, 2.0, 0.02)
    step = (time_s >= 1.0).astype(float)
    still, up = np.zeros((100, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (100, 1))
    log = FlightLog(
        "made",
        time_s,
        still,
        up,
        still,
        step[:, None] * [1.0, 0.0, 0.0],
        pwm=np.repeat(step[:, None], 4, axis=1),
    )
    flight = grid_of(log)
    at = round(0.996 / STEP_S)
    assert flight.signals["pwm"][at, 0] == 0.0
    np.testing.assert_allclose(flight.signals["rate_b"][at, 0], 0.8)
    assert not flight.has("voltage")


def test_a_command_counts_from_its_stamp_wherever_that_is_on_the_grid():
    rng = np.random.default_rng(0)
    time_s = np.concatenate([[0.0], np.cumsum(rng.uniform(0.004, 0.012, 400))])
    still, up = np.zeros((401, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (401, 1))
    asked = rng.standard_normal((401, 4))
    log = FlightLog("made", time_s, still, up, still, still, pwm=asked)
    held = grid_of(log).signals["pwm"]
    for k in (0, 17, 100, 250):
        fine = STEP_S * (k + (np.arange(4000) + 0.5) / 4000)
        mean = asked[np.searchsorted(time_s, fine, side="right") - 1].mean(axis=0)
        np.testing.assert_allclose(held[k], mean, atol=2e-3)


def test_rates_that_are_not_logged_come_of_the_attitude():
    time_s = np.arange(0.0, 2.0, 0.01)
    half = 0.5 * 0.8 * time_s
    quat = np.stack([np.cos(half), np.sin(half), 0 * half, 0 * half], axis=1)
    still, none = np.zeros((200, 3)), np.full((200, 3), np.nan)
    log = FlightLog("made", time_s, still, quat, still, none, pwm=np.zeros((200, 4)))
    rate_b = grid_of(log).signals["rate_b"]
    known = np.asarray(np.isfinite(rate_b).all(axis=1))
    assert known[10:-10].all()
    np.testing.assert_allclose(rate_b[known], np.tile([0.8, 0.0, 0.0], (known.sum(), 1)), atol=1e-9)


COUNT = 400
SECONDS = 0.01 * np.arange(COUNT)


def logged(**signals):
    still, up = np.zeros((COUNT, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (COUNT, 1))
    whole = {"pos_w": still, "quat_wxyz": up, "vel_w": still, "rate_b": still}
    return FlightLog("made", SECONDS, **{**whole, **signals})


def in_turn(values):
    """Values of which every row has one column only."""
    count, width = values.shape
    return np.where(np.arange(count)[:, None] % width == np.arange(width), values, np.nan)


def test_motors_that_are_logged_in_turn_are_each_taken_by_their_own_rows():
    ramp = np.add.outer(100.0 * SECONDS, [0.0, 10.0, 20.0, 30.0])
    flight = grid_of(logged(rotor_speed=in_turn(ramp), pwm=in_turn(np.full((COUNT, 4), 0.5))))
    assert flight.in_turn == ("rotor_speed", "pwm")
    known = flight.signals["rotor_speed"]
    good = np.asarray(np.isfinite(known).all(axis=1))
    assert good[10:-10].all()
    wanted = np.add.outer(100.0 * flight.time_s[good], [0.0, 10.0, 20.0, 30.0])
    np.testing.assert_allclose(known[good], wanted)
    np.testing.assert_allclose(flight.signals["pwm"][10:-10], 0.5)
    assert grid_of(logged(rotor_speed=ramp)).in_turn == ()


def test_motors_in_turn_are_as_noisy_as_they_are():
    rng = np.random.default_rng(0)
    speed = in_turn(1000.0 + 8.0 * rng.standard_normal((COUNT, 4)))
    noise = grid_of(logged(rotor_speed=speed)).signals[ROTOR_NOISE]
    assert np.isfinite(noise[10:-10]).all()
    # On the grid it is joined by lines, which leaves two thirds of the variance.
    assert np.nanstd(noise) == pytest.approx(8.0 * np.sqrt(2.0 / 3.0), rel=0.15)


@pytest.mark.parametrize(
    "name", ["pos_w", "vel_w", "rate_b", "rotor_speed", "pwm", "rate_cmd_b", "thrust_cmd"]
)
def test_a_signal_of_one_row_is_none(name):
    width = {"rotor_speed": (4,), "pwm": (4,), "thrust_cmd": ()}.get(name, (3,))
    values = np.full((COUNT, *width), np.nan)
    values[0] = 1.0
    # Rates that are not logged come of the attitude.
    level = np.full((COUNT, 4), np.nan)
    assert not grid_of(logged(**{"quat_wxyz": level, name: values})).has(name)


def test_an_attitude_or_a_voltage_of_one_row_is_none():
    quat, volts = np.full((COUNT, 4), np.nan), np.full(COUNT, np.nan)
    quat[0], volts[0] = [1.0, 0.0, 0.0, 0.0], 15.0
    assert not {"rot_w", "voltage"} & {*grid_of(logged(quat_wxyz=quat, voltage=volts)).signals}

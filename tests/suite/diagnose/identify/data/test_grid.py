"""Windows are exact on lines and parabolas; commands hold, holes stay holes."""

from functools import partial

import numpy as np
import pytest

from suite.diagnose.identify.grid import ROTOR_NOISE, STEP_S, FlightGrid, grid_of
from tests.support.log_tables import level


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


COUNT = 400
SECONDS = 0.01 * np.arange(COUNT)


logged = partial(level, SECONDS)


def test_a_command_counts_from_its_stamp_and_measurements_are_joined():
    rng = np.random.default_rng(0)
    time_s = np.concatenate([[0.0], np.cumsum(rng.uniform(0.004, 0.012, COUNT - 1))])
    pwm, rate_b = rng.standard_normal((COUNT, 4)), rng.standard_normal((COUNT, 3))
    flight = grid_of(level(time_s, pwm=pwm, rate_b=rate_b))
    assert not flight.has("voltage")
    for k in (0, 17, 100, 250):
        fine_s = STEP_S * (k + (np.arange(4000) + 0.5) / 4000)
        mean = pwm[np.searchsorted(time_s, fine_s, side="right") - 1].mean(axis=0)
        np.testing.assert_allclose(flight.signals["pwm"][k], mean, atol=2e-3)
        joined = [np.interp(flight.time_s[k], time_s, column) for column in rate_b.T]
        np.testing.assert_allclose(flight.signals["rate_b"][k], joined, atol=1e-9)


def in_turn(values):
    """Return values of which every row has one column only."""
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
    speed = in_turn(1000.0 + 8.0 * np.random.default_rng(0).standard_normal((COUNT, 4)))
    noise = grid_of(logged(rotor_speed=speed)).signals[ROTOR_NOISE]
    assert np.isfinite(noise[10:-10]).all()
    # On the grid it is joined by lines, which leaves two thirds of the variance.
    assert np.nanstd(noise) == pytest.approx(8.0 * np.sqrt(2.0 / 3.0), rel=0.15)


@pytest.mark.parametrize(
    ("name", "width"),
    [("pos_w", (3,)), ("vel_w", (3,)), ("rate_b", (3,)), ("rotor_speed", (4,)), ("pwm", (4,)),
     ("rate_cmd_b", (3,)), ("thrust_cmd", ()), ("voltage", ()), ("quat_wxyz", (4,))],
)  # fmt: skip
def test_a_signal_of_one_row_is_none(name, width):
    values = np.full((COUNT, *width), np.nan)
    values[0] = 0.5
    # Rates that are not logged are computed from the attitude.
    flat = np.full((COUNT, 4), np.nan)
    flight = grid_of(logged(**{"quat_wxyz": flat, name: values}))
    assert not flight.has({"quat_wxyz": "rot_w"}.get(name, name))

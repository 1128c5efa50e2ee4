"""Windows are exact on lines and parabolas; commands hold, holes stay holes."""

import numpy as np

from eval.logs.flight_log import FlightLog
from suite.diagnose.identify.data.grid import STEP_S, FlightGrid, grid_of, over, windows_of


def grid(values):
    time_s = STEP_S * np.arange(len(values))
    return FlightGrid("made", time_s, {"x": np.asarray(values, dtype=float)[:, None]})


def test_slope_and_bend_of_a_parabola():
    time_s = STEP_S * np.arange(500)
    flight = grid(3.0 + 2.0 * time_s + 5.0 * time_s**2)
    windows = windows_of(flight, 0.2, ("x",))
    at = time_s[windows.middle]
    values = flight.known["x"]
    slope = over(windows, values, windows.slope)[:, 0]
    np.testing.assert_allclose(slope, 2.0 + 10.0 * at, rtol=1e-9)
    np.testing.assert_allclose(over(windows, values, windows.bend), 10.0, rtol=1e-8)
    constant = grid(np.full(500, 7.0)).known["x"]
    np.testing.assert_allclose(over(windows, constant, windows.bend), 0.0, atol=1e-9)
    np.testing.assert_allclose(over(windows, constant), 7.0)


def test_no_window_lies_over_a_hole():
    values = np.ones(500)
    values[250] = np.nan
    flight = grid(values)
    for first in windows_of(flight, 0.2, ("x",)).first:
        assert not first <= 250 < first + 51


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
    assert flight.known["pwm"][at, 0] == 0.0
    np.testing.assert_allclose(flight.known["rate_b"][at, 0], 0.8)
    assert not flight.has("voltage")


def test_a_command_counts_from_its_stamp_wherever_that_is_on_the_grid():
    rng = np.random.default_rng(0)
    time_s = np.concatenate([[0.0], np.cumsum(rng.uniform(0.004, 0.012, 400))])
    still, up = np.zeros((401, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (401, 1))
    asked = rng.standard_normal((401, 4))
    log = FlightLog("made", time_s, still, up, still, still, pwm=asked)
    held = grid_of(log).known["pwm"]
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
    rate_b = grid_of(log).known["rate_b"]
    known = np.asarray(np.isfinite(rate_b).all(axis=1))
    assert known[10:-10].all()
    np.testing.assert_allclose(rate_b[known], np.tile([0.8, 0.0, 0.0], (known.sum(), 1)), atol=1e-9)

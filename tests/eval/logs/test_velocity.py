"""Velocity from positions follows a flight over jitter and holes."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from eval.logs.flight_log import (
    columns_from_log,
    log_from_columns,
    log_from_flight,
    read_flight,
    write_flight,
)
from eval.logs.velocity import velocity_from_position
from tests.support.flights import small_track, smooth_flight


def test_derived_velocity_follows_a_racing_flight_over_jitter_and_holes(tmp_path):
    rng = np.random.default_rng(3)
    flight = smooth_flight(small_track(8), speed=6.0)
    keep = rng.random(len(flight.time_s)) > 0.1
    keep[100:112] = False
    table = columns_from_log(replace(log_from_flight(flight), extra={}))
    table = {name: values[keep] for name, values in table.items() if not name.startswith("vel")}
    table["pos_x"][20] = np.nan
    log = log_from_columns(table, {}, "a")
    assert log.velocity_derived
    error = np.linalg.norm(log.vel_w - flight.vel_w[keep], axis=1)
    # A spline's jerk steps at its knots, up to 400 m/s^3 here, which a cubic cannot follow.
    assert np.median(error) < 0.02 and error.max() < 0.5
    back = read_flight(write_flight(tmp_path / "a.parquet", log))
    assert back.velocity_derived
    np.testing.assert_array_equal(back.vel_w, log.vel_w)


@settings(max_examples=40)
@given(seed=st.integers(0, 10_000), rate=st.sampled_from([20, 100, 500]))
def test_derived_velocity_of_a_cubic_is_exact_at_any_sampling(seed, rate):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.5, 1.5, 2 * rate)) / rate
    curve = np.polynomial.Polynomial(rng.normal(size=4) * [1e4, 5, 3, 1])
    pos = np.stack([curve(time), -curve(time), np.ones(len(time))], axis=1)
    slope = curve.deriv()(time)
    expected = np.stack([slope, -slope, np.zeros(len(time))], axis=1)
    np.testing.assert_allclose(velocity_from_position(time, pos), expected, atol=1e-5)


def test_derived_velocity_where_little_is_known():
    time = np.array([0.0, 1.0, 1.01, 5.0, 9.0])
    pos = np.stack([3 * time, 0 * time, 0 * time], axis=1)
    pos[1] = np.nan
    velocity = velocity_from_position(time, pos)
    assert np.isnan(velocity_from_position(time, np.full((5, 3), np.nan))).all()
    assert np.all(np.isnan(velocity[:, 0]) | (np.abs(velocity[:, 0] - 3) < 1e-9))

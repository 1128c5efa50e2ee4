"""Wind: steady, and gusts of the stated size and colour."""

import numpy as np
import pytest

from suite.blind.continuous.air import Wind
from tests.support.vehicles import with_effects


def test_no_wind_is_still_and_a_steady_one_does_not_change():
    assert Wind({}, 2, np.random.default_rng(0)).still
    effects = dict(with_effects(constant_wind=((1.0, -2.0, 0.5),)).effects)
    wind = Wind(effects, 2, np.random.default_rng(0))
    before, after = wind.step(np.zeros((2, 3)), np.full((2, 1), 0.1))
    np.testing.assert_array_equal(before, [[1.0, -2.0, 0.5]] * 2)
    np.testing.assert_array_equal(after, before)
    assert not wind.still


def test_gusts_have_their_intensity_and_forget_with_their_length():
    effects = dict(with_effects(gusts=(1.5, 4.0), constant_wind=((2.0, 0.0, 0.0),)).effects)
    wind = Wind(effects, 20_000, np.random.default_rng(1))
    # 7 m/s over ground against a mean wind of 2 m/s along it: 5 m/s through the air.
    vel_w, length_s = np.tile([7.0, 0.0, 0.0], (20_000, 1)), np.full((20_000, 1), 0.002)
    first = wind.now_w - [2.0, 0.0, 0.0]
    for _ in range(199):
        wind.step(vel_w, length_s)
    _, after = wind.step(vel_w, length_s)
    last = after - [2.0, 0.0, 0.0]
    for series in (first, last):
        np.testing.assert_allclose(series.std(axis=0), [1.5, 1.5, 0.75], rtol=0.02)
    # After 0.4 s: exp(-0.4 x 5 / 4).
    kept = (first * last).mean(axis=0) / (first**2).mean(axis=0)
    np.testing.assert_allclose(kept, np.exp(-0.5), atol=0.02)
    np.testing.assert_array_equal(wind.now_w, after)
    still = wind.step(vel_w, 0.0 * length_s)
    np.testing.assert_array_equal(*still)


def test_a_slow_vehicle_sees_gusts_change_as_at_a_metre_a_second():
    effects = dict(with_effects(gusts=(1.0, 2.0)).effects)
    wind = Wind(effects, 20_000, np.random.default_rng(1))
    first = wind.now_w
    _, after = wind.step(np.zeros((20_000, 3)), np.full((20_000, 1), 1.0))
    assert (first * after).mean() / (first**2).mean() == pytest.approx(np.exp(-0.5), abs=0.02)

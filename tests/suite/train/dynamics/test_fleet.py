"""The distribution of quadrotors: what is drawn, in its ranges, the same again, faults apart."""

from dataclasses import replace

import numpy as np
import pytest

from suite.train.config import TrainConfig, check
from suite.train.dynamics.fleet import FleetConfig, draw_vehicles

WHOLE = FleetConfig(fault_share=1.0)


def drawn(config=WHOLE, batch=4000, seed=0):
    return draw_vehicles(config, 1 / 15, batch, np.random.default_rng(seed))


def test_everything_lies_in_its_stated_range_and_fills_it():
    fleet = drawn()
    spans = {
        "rotor_lag": WHOLE.rotor_lag_s,
        "delay": WHOLE.delay_s,
        "rate_max": WHOLE.rate_max,
        "thrust_max": tuple(9.81 * x for x in WHOLE.thrust_to_weight),
        "force_scale": (0.85 / 1.2, 1.08 / 0.92),
        "state_latency": WHOLE.state_latency_s,
        "image_latency": WHOLE.image_latency_s,
    }
    for name, (low, high) in spans.items():
        array = getattr(fleet, name)
        assert low <= array.min() and array.max() <= high, name
        assert np.ptp(array) > 0.8 * (high - low), name
    np.testing.assert_array_less(fleet.drag.max(0), [0.6, 0.6, 1.4])
    np.testing.assert_array_less(fleet.quadratic.max(0), [0.03, 0.03, 0.09])
    assert np.mean(fleet.integral_gain[:, 0] > 0) == pytest.approx(0.3, abs=0.03)


def test_only_faulty_vehicles_are_not_what_their_controllers_believe():
    fleet = drawn(replace(WHOLE, fault_share=0.25))
    faulty = fleet.force_scale != 1.0
    assert faulty.mean() == pytest.approx(0.25, abs=0.03)
    for array in (fleet.turn_by_thrust[:, 0], fleet.trim[:, 0]):
        np.testing.assert_array_equal(array != 0.0, faulty)
    sound = fleet.rate_gain[~faulty]
    np.testing.assert_allclose(sound[:, 0], sound[:, 1], err_msg="the same inertia on each axis")


def test_weak_rotors_turn_the_body_less_but_about_z():
    config = replace(WHOLE, inertia_scale=(1.25, 1.25), thrust_scale=(0.85, 0.85))
    weak, sound = drawn(config), drawn(replace(config, fault_share=0.0))
    for name in ("rate_gain", "turn_max"):
        ratio = getattr(weak, name) / getattr(sound, name)
        np.testing.assert_allclose(ratio, np.broadcast_to([0.68, 0.68, 0.8], ratio.shape))


def test_a_centre_of_mass_10_mm_to_the_left_rolls_a_5_inch_racer_to_the_right():
    """0.75 kg that hover: 7.36 N on the arm of 10 mm, over 0.0025 kg m^2."""
    config = replace(WHOLE, gyration_m=(0.05773503, 0.05773503), com_offset_m=0.01)
    fleet = drawn(config)
    # Both are drawn; the largest draw is twice the deviation, 20 mm.
    assert 9.81 * np.abs(fleet.turn_by_thrust).max() == pytest.approx(2 * 29.43, rel=0.02)
    assert not fleet.turn_by_thrust[:, 2].any()


def test_the_same_draws_again_and_a_run_refuses_a_range_upside_down():
    for one, two in zip(drawn(), drawn(), strict=True):
        np.testing.assert_array_equal(one, two)
    bad = replace(TrainConfig(), fleet=replace(WHOLE, rotor_lag_s=(0.05, 0.01)))
    with pytest.raises(ValueError, match=r"fleet\.rotor_lag_s"):
        check(bad)

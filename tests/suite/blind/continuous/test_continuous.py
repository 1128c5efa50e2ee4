"""The engine shares nothing with the model that fits, and converges; stamps and late commands."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

import suite.blind.continuous
from eval.flights.simulate import SENSORS
from eval.flights.trajectory import Trajectory
from suite.blind.continuous.body import POS, QUAT, RATE, VEL
from suite.blind.continuous.timing import (
    CLOCK_S,
    COLOUR_S,
    DROPPED,
    JITTER,
    Conditions,
    draw_conditions,
    jittered_stamps,
    schedule,
)
from suite.blind.continuous_flight import fly_continuous, with_loop_frequency
from tests.suite.test_imports import imported
from tests.support.vehicles import PLAIN, with_effects, with_lag

FOLDER = Path(suite.blind.continuous.__file__).parent
ALLOWED = ("suite.blind.continuous", "eval.vehicles.vehicle", "eval.logs.flight_log")
"""What of the house the engine may know: its own folder, and the numbers of vehicles and logs."""
WAYS = (
    Trajectory("figure_eight", 0.4, speed=6.0, size=3.0, turn="wobble", height=0.5),
    Trajectory("low", 0.4, speed=1.5, size=1.0, height=0.14),
)


def test_no_module_of_the_engine_imports_the_model_that_fits():
    for path in FOLDER.glob("*.py"):
        for name in imported(path):
            if name.split(".")[0] in ("eval", "suite", "tracks", "policies"):
                assert name.startswith(ALLOWED), f"{path.name} imports {name}"


@pytest.mark.parametrize("lag", [pytest.param(0.0, marks=pytest.mark.slow), 0.02])
def test_a_finer_step_changes_a_flight_by_far_less_than_the_noise(lag):
    truth = with_effects(
        with_lag(PLAIN, lag),
        linear_drag=((0.3, 0.2, 0.1),),
        quadratic_drag=((0.03, 0.02, 0.04),),
        inflow=(4e-4,),
        ground_effect=(4.0, 0.0635),
        blade_flapping=(1e-6,),
        command_delay=(0.0123,),
        battery_sag=(0.005, 0.0),
        rotor_gyroscopic=(2e-5,),
    )
    conditions = Conditions(333.0, 97.0, 0.3, 0.0, 0.0, 0.0, 0.1)

    def rows(step_s):
        flown = fly_continuous(
            PLAIN, truth, WAYS, conditions, np.random.default_rng(3), step_s=step_s
        )
        return flown.state[flown.schedule.block[:-1]], flown.acc_b

    (coarse, acc), (fine, fine_acc) = rows(1e-3), rows(5e-4)
    noise = SENSORS["full"]
    apart = np.abs(coarse - fine).max(axis=(0, 1))
    assert len(coarse) > 80
    sizes = ((POS, noise.pos), (VEL, noise.vel), (QUAT, noise.attitude), (RATE, noise.gyro))
    for part, size in sizes:
        assert apart[part].max() < 1e-4 * size
    assert np.abs(acc - fine_acc).max() < 1e-4 * noise.acc


def test_the_error_falls_with_the_fourth_power_of_the_step():
    # Without ticks in between: a loop as slow as the rows, so that steps are as long as allowed.
    truth = with_lag(with_effects(quadratic_drag=((0.5, 0.4, 0.3),)), 0.02)
    conditions = Conditions(50.0, 50.0, 0.0, 0.0, 0.0, 0.0, 0.1)

    def last(step_s):
        flown = fly_continuous(
            with_loop_frequency(PLAIN, 50.0), truth, WAYS[:1], conditions, np.random.default_rng(3),
            step_s=step_s,
        )  # fmt: skip
        return flown.state[-1, 0, VEL]

    exact = last(2.5e-4)
    coarse, fine = (np.abs(last(step_s) - exact).max() for step_s in (4e-3, 2e-3))
    assert 12.0 < coarse / fine < 20.0


def starts(plan, mask, flight=0):
    return plan.start_s[mask[:, flight], flight]


def test_the_loop_starts_its_period_anew_at_every_row():
    stamps = np.array([[0.0], [0.007], [0.0125], [0.02]])
    plan = schedule(stamps, 0.003, 0.0, step_s=0.001)
    ticks = [0.0, 0.003, 0.006, 0.007, 0.010, 0.0125, 0.0155, 0.0185]
    np.testing.assert_allclose(starts(plan, plan.is_tick), ticks, atol=1e-12)
    assert plan.length_s.max() <= 0.001 + 1e-9
    ends = plan.start_s + plan.length_s
    np.testing.assert_allclose(ends[:-1], plan.start_s[1:], atol=1e-12)
    assert ends[-1, 0] == pytest.approx(0.02)


def test_a_command_acts_from_its_stamp_on_and_a_late_one_inside_a_period():
    stamps = np.array([[0.0], [0.007], [0.0125], [0.02]])
    at_once = schedule(stamps, 0.003, 0.0)
    row = np.searchsorted(stamps[:, 0], at_once.start_s[:, 0] + 1e-9, side="right") - 1
    np.testing.assert_array_equal(at_once.acting[:, 0], row)
    late = schedule(stamps, 0.003, 0.0042)
    changes = np.flatnonzero(np.diff(late.acting[:, 0])) + 1
    np.testing.assert_allclose(late.start_s[changes, 0], [0.0042, 0.0112, 0.0167], atol=1e-12)
    assert late.acting[0, 0] == -1 and not late.is_tick[changes, 0].any()
    # The delay does not move the loop.
    np.testing.assert_allclose(
        starts(late, late.is_tick), starts(at_once, at_once.is_tick), atol=1e-12
    )


def test_flights_side_by_side_keep_their_own_times():
    rng = np.random.default_rng(2)
    stamps = jittered_stamps(rng, 3, -0.1, 0.4, 90.0, 0.3)
    both = schedule(stamps, 1 / 410.0, 0.013)
    for flight in range(3):
        alone = schedule(stamps[:, flight : flight + 1], 1 / 410.0, 0.013)
        moving = both.length_s[:, flight] > 0.0
        assert not both.is_tick[~moving, flight].any(), "who waits does nothing"
        for name in ("start_s", "length_s", "is_tick", "acting"):
            np.testing.assert_array_equal(
                getattr(both, name)[moving, flight], getattr(alone, name)[:, 0]
            )
        # Waiting at the end of a row, with the command that acted last.
        idle = np.flatnonzero(~moving)
        np.testing.assert_array_equal(both.acting[idle, flight], both.acting[idle - 1, flight])
    np.testing.assert_array_equal(both.start_s[both.block[:-1]], stamps[:-1])


def test_jitter_stays_within_its_share_of_a_row_but_for_the_first():
    stamps = jittered_stamps(np.random.default_rng(0), 4, -0.25, 5.0, 200.0, 0.3)
    number = np.round(stamps * 200.0)
    off = stamps * 200.0 - number
    assert np.abs(off).max() <= 0.3 + 1e-9 and np.abs(off).max() > 0.29
    first = np.flatnonzero((number == 0).all(axis=1))
    np.testing.assert_array_equal(stamps[first], 0.0)
    assert (np.diff(stamps, axis=0) > 0.4 / 200.0 - 1e-9).all()
    assert stamps[0].max() < -0.24 and stamps[-1].min() > 5.0
    assert np.std(off[:, 0] - off[:, 1]) > 0.1, "each flight has its own"
    even = jittered_stamps(np.random.default_rng(0), 2, 0.0, 1.0, 100.0, 0.0)
    np.testing.assert_allclose(np.diff(even, axis=0), 0.01)


def test_conditions_are_within_bounds_and_of_every_kind():
    drawn = [draw_conditions(np.random.default_rng(seed)) for seed in range(400)]
    values = {name: np.array([asdict(c)[name] for c in drawn]) for name in asdict(drawn[0])}
    for name, low, high in (
        ("loop_hz", 200.0, 2000.0),
        ("row_hz", 50.0, 1000.0),
        ("jitter", 0.0, JITTER),
        ("clock_s", 0.0, CLOCK_S),
        ("dropped", 0.0, DROPPED),
        ("colour_s", *COLOUR_S),
    ):
        assert low <= values[name].min() and values[name].max() <= high, name
        assert values[name].min() < low + 0.1 * (high - low), name
        assert values[name].max() > high - 0.1 * (high - low), name
    assert JITTER == 0.3 and CLOCK_S == 1e-4
    assert (values["row_hz"] <= values["loop_hz"]).all()
    assert 0.4 < (values["coloured"] > 0.0).mean() < 0.6
    assert 0.1 < (values["jitter"] == 0.0).mean() < 0.3
    assert draw_conditions(np.random.default_rng(7)) == drawn[7]

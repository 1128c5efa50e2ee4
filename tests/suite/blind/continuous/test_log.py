"""The engine of the blind cases apart from the model that fits, in time, and in what it logs."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

import suite.blind.continuous
from eval.flights.simulate import SENSORS, Sensors
from eval.flights.trajectory import Trajectory
from suite.blind.continuous import timing
from suite.blind.continuous.body import POS, QUAT, RATE, VEL, Battery
from suite.blind.continuous.engine import fly
from suite.blind.continuous.log import gauss_markov, log_of_flight, rotate_attitude, state_at
from suite.blind.continuous.quadrotor import quadrotor_of
from suite.blind.continuous_flight import fly_continuous, with_loop_frequency
from tests.suite.test_imports import imported
from tests.support.vehicles import PLAIN, with_effects, with_lag

FOLDER = Path(suite.blind.continuous.__file__).parent
ALLOWED = ("suite.blind.continuous", "eval.vehicles.vehicle", "eval.logs.flight_log")
"""What of the house the engine may know: its own folder, and the numbers of vehicles and logs."""
WAYS = (
    Trajectory("figure_eight", 0.2, speed=6.0, size=3.0, turn="wobble", height=0.5),
    Trajectory("low", 0.2, speed=1.5, size=1.0, height=0.14),
)


def test_no_module_of_the_engine_imports_the_model_that_fits():
    for path in FOLDER.glob("*.py"):
        for name in imported(path):
            if name.split(".")[0] in ("eval", "suite", "tracks", "policies"):
                assert name.startswith(ALLOWED), f"{path.name} imports {name}"


def stepped(nominal, truth, ways, conditions, step_s):
    """Return flights with steps of at most `step_s`."""
    rng = np.random.default_rng(3)
    return fly_continuous(nominal, truth, ways, conditions, rng, step_s=step_s)


@pytest.mark.extended
@pytest.mark.parametrize("lag", [0.0, 0.02])
def test_a_finer_step_changes_a_flight_by_far_less_than_the_noise(lag):
    drag = {"linear_drag": ((0.3, 0.2, 0.1),), "quadratic_drag": ((0.03, 0.02, 0.04),)}
    air = {"inflow": (4e-4,), "ground_effect": (4.0, 0.0635), "blade_flapping": (1e-6,)}
    rest = {"command_delay": (0.0123,), "battery_sag": (0.005, 0.0), "rotor_gyroscopic": (2e-5,)}
    truth = with_effects(with_lag(PLAIN, lag), **drag, **air, **rest)
    conditions = timing.Conditions(333.0, 97.0, 0.3, 0.0, 0.0, 0.0, 0.1)

    coarse, fine = (stepped(PLAIN, truth, WAYS, conditions, step_s) for step_s in (1e-3, 5e-4))
    rows, noise = coarse.schedule.block[:-1], SENSORS["full"]
    assert len(rows) > 60
    apart = np.abs(coarse.state[rows] - fine.state[fine.schedule.block[:-1]]).max(axis=(0, 1))
    sizes = ((POS, noise.pos), (VEL, noise.vel), (QUAT, noise.attitude), (RATE, noise.gyro))
    for part, size in sizes:
        assert apart[part].max() < 1e-4 * size
    assert np.abs(coarse.acc_b - fine.acc_b).max() < 1e-4 * noise.acc


@pytest.mark.extended
def test_the_error_falls_with_the_fourth_power_of_the_step():
    # Without ticks in between: a loop as slow as the rows, so that steps are as long as allowed.
    truth = with_lag(with_effects(quadratic_drag=((0.5, 0.4, 0.3),)), 0.02)
    conditions = timing.Conditions(50.0, 50.0, 0.0, 0.0, 0.0, 0.0, 0.1)

    slow = with_loop_frequency(PLAIN, 50.0)
    runs = [stepped(slow, truth, WAYS[:1], conditions, step) for step in (5e-4, 4e-3, 2e-3)]
    exact, coarse, fine = (run.state[-1, 0, VEL] for run in runs)
    assert 12.0 < np.abs(coarse - exact).max() / np.abs(fine - exact).max() < 20.0


STAMPS = np.array([[0.0], [0.007], [0.0125], [0.02]])


def ticks(plan):
    return plan.start_s[plan.is_tick[:, 0], 0]


def test_the_loop_starts_its_period_anew_at_every_row():
    plan = timing.schedule(STAMPS, 0.003, 0.0, step_s=0.001)
    wanted = [0.0, 0.003, 0.006, 0.007, 0.010, 0.0125, 0.0155, 0.0185]
    np.testing.assert_allclose(ticks(plan), wanted, atol=1e-12)
    assert plan.length_s.max() <= 0.001 + 1e-9
    ends = plan.start_s + plan.length_s
    np.testing.assert_allclose(ends[:-1], plan.start_s[1:], atol=1e-12)
    assert ends[-1, 0] == pytest.approx(0.02)


def test_a_command_acts_from_its_stamp_on_and_a_late_one_inside_a_period():
    at_once = timing.schedule(STAMPS, 0.003, 0.0)
    row = np.searchsorted(STAMPS[:, 0], at_once.start_s[:, 0] + 1e-9, side="right") - 1
    np.testing.assert_array_equal(at_once.acting[:, 0], row)
    late = timing.schedule(STAMPS, 0.003, 0.0042)
    changes = np.flatnonzero(np.diff(late.acting[:, 0])) + 1
    np.testing.assert_allclose(late.start_s[changes, 0], [0.0042, 0.0112, 0.0167], atol=1e-12)
    assert late.acting[0, 0] == -1 and not late.is_tick[changes, 0].any()
    np.testing.assert_allclose(ticks(late), ticks(at_once), atol=1e-12)  # not moved by the delay


def test_flights_side_by_side_keep_their_own_times():
    rng = np.random.default_rng(2)
    stamps = timing.jittered_stamps(rng, 3, -0.1, 0.4, 90.0, 0.3)
    both = timing.schedule(stamps, 1 / 410.0, 0.013)
    for flight in range(3):
        alone = timing.schedule(stamps[:, flight : flight + 1], 1 / 410.0, 0.013)
        moving = both.length_s[:, flight] > 0.0
        assert not both.is_tick[~moving, flight].any(), "who waits does nothing"
        for name in ("start_s", "length_s", "is_tick", "acting"):
            beside = getattr(both, name)[moving, flight]
            np.testing.assert_array_equal(beside, getattr(alone, name)[:, 0])
        # Waiting at the end of a row, with the command that acted last.
        idle = np.flatnonzero(~moving)
        np.testing.assert_array_equal(both.acting[idle, flight], both.acting[idle - 1, flight])
    np.testing.assert_array_equal(both.start_s[both.block[:-1]], stamps[:-1])


def test_jitter_stays_within_its_share_of_a_row_but_for_the_first():
    stamps = timing.jittered_stamps(np.random.default_rng(0), 4, -0.25, 5.0, 200.0, 0.3)
    number = np.round(stamps * 200.0)
    off = stamps * 200.0 - number
    assert np.abs(off).max() <= 0.3 + 1e-9 and np.abs(off).max() > 0.29
    np.testing.assert_array_equal(stamps[(number == 0).all(axis=1)], 0.0)
    assert (np.diff(stamps, axis=0) > 0.4 / 200.0 - 1e-9).all()
    assert stamps[0].max() < -0.24 and stamps[-1].min() > 5.0
    assert np.std(off[:, 0] - off[:, 1]) > 0.1, "each flight has its own"
    even = timing.jittered_stamps(np.random.default_rng(0), 2, 0.0, 1.0, 100.0, 0.0)
    np.testing.assert_allclose(np.diff(even, axis=0), 0.01)


def test_conditions_are_within_bounds_and_of_every_kind():
    drawn = [timing.draw_conditions(np.random.default_rng(seed)) for seed in range(400)]
    values = {name: np.array([asdict(c)[name] for c in drawn]) for name in asdict(drawn[0])}
    for name, low, high in (
        ("loop_hz", 200.0, 2000.0),
        ("row_hz", 50.0, 1000.0),
        ("jitter", 0.0, timing.JITTER),
        ("clock_s", 0.0, timing.CLOCK_S),
        ("dropped", 0.0, timing.DROPPED),
        ("colour_s", *timing.COLOUR_S),
    ):
        assert low <= values[name].min() and values[name].max() <= high, name
        assert values[name].min() < low + 0.1 * (high - low), name
        assert values[name].max() > high - 0.1 * (high - low), name
    assert timing.JITTER == 0.3 and timing.CLOCK_S == 1e-4
    assert (values["row_hz"] <= values["loop_hz"]).all()
    assert 0.4 < (values["coloured"] > 0.0).mean() < 0.6
    assert 0.1 < (values["jitter"] == 0.0).mean() < 0.3
    assert timing.draw_conditions(np.random.default_rng(7)) == drawn[7]


NOISE = Sensors("", 100.0, 0.002, 0.003, 0.02, 0.03, 0.3, 5.0, 0.02, 0.0)
EVEN = timing.Conditions(500.0, 200.0, 0.0, 0.0, 0.0, 0.0, 0.1)


def pilot(seen):
    wave = np.sin(12.0 * seen.time_s)
    command = np.stack([9.81 + wave, 0.6 * np.cos(9.0 * seen.time_s), 0.5 * wave, wave], axis=1)
    return command, command


def fly_at(stamps, **step):
    start = np.zeros((1, 13))
    start[0, POS], start[0, VEL], start[0, QUAT] = [0, 0, 9], [2, 1, 0], [1, 0, 0, 0]
    plan, battery = timing.schedule(stamps, 0.002, 0.0, **step), Battery(16, 0.1, 0.3)
    return fly(quadrotor_of(PLAIN), plan, start, pilot, np.random.default_rng(0), battery)


@pytest.fixture(scope="module")
def flown():
    stamps = timing.jittered_stamps(np.random.default_rng(1), 1, -0.1, 2.1, 200.0, 0.3)
    return fly_at(stamps)


def logged(flown, rng=None, conditions=EVEN, noise=NOISE, **faults):
    effects = with_effects(**faults).effects
    return log_of_flight(flown, 0, 2.0, effects, noise, conditions, rng, "log", {"source": "x"})


def test_without_noise_rows_are_the_states_at_their_stamps(flown):
    log, plan = logged(flown), flown.schedule
    rows = np.flatnonzero((plan.stamp_s[:-1, 0] >= 0.0) & (plan.stamp_s[:-1, 0] < 2.0))
    state = flown.state[plan.block[rows], 0]
    np.testing.assert_array_equal(log.time_s, plan.stamp_s[rows, 0])
    assert log.time_s[0] == 0.0
    for values, part in ((log.pos_w, POS), (log.vel_w, VEL), (log.rate_b, RATE)):
        np.testing.assert_array_equal(values, state[:, part])
    np.testing.assert_array_equal(log.quat_wxyz, state[:, QUAT])
    np.testing.assert_allclose(log.thrust_cmd, 9.81 + np.sin(12.0 * log.time_s))
    np.testing.assert_allclose(log.rate_cmd_b[:, 0], 0.6 * np.cos(9.0 * log.time_s))
    assert dict(log.about) == {"source": "x"} and log.integrator is None


def test_biases_are_added_and_the_flight_is_the_same(flown):
    gyro, acc = (0.1, -0.2, 0.3), (1.0, 2.0, -3.0)
    plain, off = logged(flown), logged(flown, gyro_bias=(gyro,), accelerometer_bias=(acc,))
    np.testing.assert_allclose(off.rate_b - plain.rate_b, [gyro] * len(plain.time_s))
    np.testing.assert_allclose(off.acc_b - plain.acc_b, [acc] * len(plain.time_s))
    np.testing.assert_array_equal(off.pos_w, plain.pos_w)


def test_a_lever_arm_logs_another_point_of_the_same_flight(flown):
    arm_b = np.array([0.06, -0.03, 0.04])
    plain, off = logged(flown), logged(flown, lever_arm=(arm_b,))
    to_point_w = off.pos_w - plain.pos_w
    np.testing.assert_allclose(
        np.swapaxes(plain.rot_w, 1, 2) @ to_point_w[..., None],
        np.broadcast_to(arm_b[:, None], (len(plain.time_s), 3, 1)),
        atol=1e-12,
    )
    # The velocity of the point is the change of its position over time.
    change = np.gradient(to_point_w, plain.time_s, axis=0)[1:-1]
    np.testing.assert_allclose((off.vel_w - plain.vel_w)[1:-1], change, atol=2e-3)
    np.testing.assert_array_equal(off.rate_b, plain.rate_b)


def test_an_attitude_offset_turns_the_logged_axes_about_body_axes(flown):
    plain, off = logged(flown), logged(flown, attitude_offset=((0.0, 0.0, 0.1),))
    turn = np.swapaxes(plain.rot_w, 1, 2) @ off.rot_w
    np.testing.assert_allclose(turn[:, 1, 0], np.sin(0.1), atol=1e-12)
    np.testing.assert_allclose(turn[:, 2, 2], 1.0, atol=1e-12)
    np.testing.assert_array_equal(off.vel_w, plain.vel_w)


@pytest.mark.parametrize("offset", [0.0173, -0.008])
def test_a_clock_offset_logs_poses_of_another_moment_and_the_rest_of_now(flown, offset):
    plain, late = logged(flown), logged(flown, clock_offset=(offset,))
    # Row t holds the pose of t - offset: a flight with rows there logs the same.
    wanted = state_at(flown, 0, plain.time_s - offset)
    np.testing.assert_array_equal(late.pos_w, wanted[:, POS])
    for name in ("rate_b", "acc_b", "rotor_speed"):
        np.testing.assert_array_equal(getattr(late, name), getattr(plain, name))
    shift = (late.pos_w - plain.pos_w + offset * plain.vel_w)[10:-10]
    acceleration = np.gradient(plain.vel_w, plain.time_s, axis=0)[10:-10]
    np.testing.assert_allclose(shift, 0.5 * offset**2 * acceleration, atol=2e-5)
    change = (late.vel_w - plain.vel_w)[10:-10]
    np.testing.assert_allclose(change, -offset * acceleration, atol=5e-3)


def test_states_between_the_ends_of_steps_are_those_of_a_finer_flight():
    stamps = np.arange(0.0, 0.101, 0.01)[:, None]
    coarse, fine = (fly_at(stamps, step_s=step_s) for step_s in (1e-3, 1e-4))
    wanted = np.random.default_rng(3).uniform(0.0, 0.1, 200)
    apart = np.abs(state_at(coarse, 0, wanted) - state_at(fine, 0, wanted)).max(axis=0)
    assert apart[POS].max() < 1e-7 and apart[VEL].max() < 3e-5 and apart[QUAT].max() < 3e-5


def test_noise_has_the_density_of_the_table_whatever_the_rate(flown):
    twin = logged(flown)
    draws = [logged(flown, np.random.default_rng(seed)) for seed in range(12)]
    for name, sigma in (
        ("pos_w", 0.002), ("vel_w", 0.03), ("rate_b", 0.02), ("acc_b", 0.3),
        ("rotor_speed", 5.0), ("voltage", 0.02),
    ):  # fmt: skip
        off = np.array([getattr(draw, name) - getattr(twin, name) for draw in draws])
        # 200 rows a second in place of 100.
        assert off.std() == pytest.approx(np.sqrt(2.0) * sigma, rel=0.05), name
    inner = np.abs([(draw.quat_wxyz * twin.quat_wxyz).sum(1) for draw in draws])
    angle = np.sqrt((8.0 * (1.0 - inner)).mean() / 3.0)
    assert angle == pytest.approx(np.sqrt(2.0) * 0.003, rel=0.05)


def test_coloured_noise_is_as_slow_as_stated_and_leaves_the_gyro_white(flown):
    coloured, twin = timing.Conditions(500.0, 200.0, 0.0, 0.0, 0.0, 0.9, 0.05), logged(flown)
    draws = [logged(flown, np.random.default_rng(seed), coloured) for seed in range(40)]
    off = np.array([draw.pos_w - twin.pos_w for draw in draws])
    # White 0.1 of 2 x 0.002^2; coloured 0.002^2 x 0.9 / (2 x 0.05 x 100).
    white, slow = 0.1 * 2.0 * 0.002**2, 0.002**2 * 0.9 / 10.0
    assert off.var() == pytest.approx(white + slow, rel=0.05)
    late = (off[:, 10:] * off[:, :-10]).mean()
    assert late == pytest.approx(slow * np.exp(-1.0), rel=0.15), "10 rows are a correlation time"
    gyro = np.array([draw.rate_b - twin.rate_b for draw in draws])
    assert gyro.var() == pytest.approx(2.0 * 0.02**2, rel=0.05)
    assert abs((gyro[:, 1:] * gyro[:, :-1]).mean()) < 0.03 * gyro.var()


def test_rows_are_dropped_with_their_commands_and_stamps_are_off_by_at_most_the_clock(flown):
    conditions = timing.Conditions(500.0, 200.0, 0.3, 1e-4, 0.05, 0.0, 0.1)
    log, all_rows = logged(flown, np.random.default_rng(4), conditions), logged(flown)
    near = np.abs(log.time_s[:, None] - all_rows.time_s).argmin(axis=1)
    off = log.time_s - all_rows.time_s[near]
    assert 0.9e-4 < np.abs(off).max() <= 1e-4
    assert 0.03 < 1.0 - len(near) / len(all_rows.time_s) < 0.07
    np.testing.assert_array_equal(log.thrust_cmd, all_rows.thrust_cmd[near])
    assert (np.diff(log.time_s) > 0.0).all() and np.isfinite(log.pos_w).all()


def test_poses_are_lost_in_threes_and_a_channel_that_is_not_measured_is_not_there(flown):
    log = logged(flown, np.random.default_rng(4), noise=replace(NOISE, lost=0.06))
    gone = np.isnan(log.pos_w[:, 0])
    np.testing.assert_array_equal(gone, np.isnan(log.quat_wxyz[:, 0]))
    assert 0.03 < gone.mean() < 0.09 and np.isfinite(log.rate_b).all()
    runs = np.diff(np.flatnonzero(np.diff(np.r_[False, gone, False])))[::2]
    assert runs.min() == 3
    log = logged(flown, np.random.default_rng(0), noise=replace(NOISE, vel=0.0, acc=0.0, rotor=0.0))
    assert log.velocity_derived and log.acc_b is None and log.rotor_speed is None


def test_small_turns_are_about_body_axes():
    # From 90 degrees about z, a turn about body x is one about world y.
    quarter = np.sqrt([[0.5, 0.0, 0.0, 0.5]])
    turn = rotate_attitude(quarter, np.array([[0.2, 0.0, 0.0]]))
    w, x, y, z = np.cos(0.1), 0.0, np.sin(0.1), 0.0
    hand = np.sqrt(0.5) * np.array([w - z, x + y, y - x, z + w])
    np.testing.assert_allclose(turn[0], hand, atol=1e-15)


def test_gauss_markov_keeps_its_variance_at_uneven_times():
    rng = np.random.default_rng(0)
    time_s = np.cumsum(rng.uniform(0.001, 0.02, 60_000))
    series = gauss_markov(rng, time_s, 0.05)
    np.testing.assert_allclose(series.std(axis=0), 1.0, atol=0.04)
    span = np.diff(time_s)
    for some in (span < 0.004, span > 0.016):
        kept = (series[1:] * series[:-1])[some].mean()
        assert kept == pytest.approx(np.exp(-span[some] / 0.05).mean(), abs=0.05)

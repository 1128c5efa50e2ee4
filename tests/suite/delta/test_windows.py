"""Flights of the point mass and of the judge cut into windows and flown again by the trainer."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.judging import judge
from eval.logs.faults.checked import CheckedFlights
from eval.logs.flight_log import log_from_flight
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules, TrialSpec
from policies.formats.policy_file import load_delta
from policies.networks import delta_network
from policies.spec import PolicySpec
from suite.common.console import Console
from suite.delta import quadrotor, run
from suite.delta import windows as module
from suite.delta.fit import FitConfig, window_errors
from suite.delta.quadrotor import cut_quadrotor_windows, replay_quadrotor, row_period
from suite.delta.replay import PointMassModel, nominal_model, replay_point_mass
from suite.train.config import PointMassConfig, QuadrotorConfig
from suite.train.dynamics import point_mass
from tests.support.broken_logs import rows
from tests.support.courses import straight
from tests.support.marks import more
from tests.support.pilots import Pursuit
from tests.support.point_mass_flights import fly
from tests.support.vehicles import PLAIN, with_effects, with_lag
from tracks.geometry.camera import Camera


def flight(count=1):
    return fly(nominal_model(PointMassConfig()), count)


def thinned(log):
    """Return a log in which every other decision is none."""
    steps = np.cumsum(log.policy_step) - 1
    return replace(log, extra={**log.extra, "policy_step": log.policy_step & (steps % 2 == 0)})


def test_the_heading_of_any_attitude_is_recovered():
    """Thrusts point up, aside and down; the point mass makes the same attitude again."""
    rng = np.random.default_rng(1)
    thrust, angle = rng.normal(0, 15, (50, 3)), rng.uniform(0, 6.3, 50)
    level = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    rot = np.array(point_mass.attitude(*map(jnp.asarray, (thrust, level))))
    assert 10 < (rot[:, 2, 2] < 0).sum() < 40
    again = point_mass.attitude(jnp.asarray(thrust), jnp.asarray(module._heading(rot)))
    np.testing.assert_allclose(again, rot, atol=1e-4)


def test_windows_begin_a_stride_apart_and_leave_out_gaps_and_what_is_missing():
    (log,) = flight()
    whole = module.cut_windows([log], 0.5, 0.1)
    pos_w = np.where(np.arange(len(log.time_s))[:, None] == 90, np.nan, log.pos_w)
    some = module.cut_windows([replace(log, pos_w=pos_w)], 0.5, 0.1)
    assert 0 < len(some.acc_w) < len(whole.acc_w) and np.all(np.isfinite(some.pos_w))
    with pytest.raises(ValueError, match="no window of 5.0 s in 1 flights \\(flight 0"):
        module.cut_windows([log], 5.0, 0.1)
    with pytest.raises(ValueError, match="flight 0: columns action_x"):
        module.cut_windows([replace(log, extra={})], 0.5, 0.1)
    for stride_s, apart_s in ((0.3, 0.3), (0.001, 1.0 / 30.0)):
        starts = module.cut_windows([log], 0.5, stride_s).pos_w[:, 0]
        at = [np.flatnonzero(np.isclose(log.pos_w, p, atol=1e-6).all(-1))[0] for p in starts]
        assert np.diff(log.time_s[at]) == pytest.approx(apart_s, abs=1e-3)
    kept = (log.time_s <= 1.4) | (log.time_s >= 1.6)
    extra = {k: np.asarray(v)[kept] for k, v in log.extra.items()}
    found = module.cut_windows([replace(rows(log, kept), extra=extra)], 0.5, 0.1)
    assert len(found.time_step) and found.time_step.max() < 0.05
    once = 1.0 * (np.arange(len(log.time_s)) == 10)
    single = replace(log, extra={**log.extra, "policy_step": once})
    words: list[str] = []
    alone = module.cut_windows([log], 0.5, 0.3, words.append)
    both = module.cut_windows([log, single], 0.5, 0.3, words.append)
    assert len(both.pos_w) == len(alone.pos_w), "a single decision makes no window"
    assert words == [f"{single.name}: not used, no window of 0.5 s {module.COMPLETE}"]


@pytest.mark.parametrize("cut", ["point mass", "quadrotor"])
def test_windows_with_a_missing_action_are_left_out(cut, logs):
    def windows(log):
        if cut == "point mass":
            return module.cut_windows([log], 0.5, 0.1)
        return cut_quadrotor_windows([log], QuadrotorConfig(TRUE), 0.5, 0.1)[0]

    log, lost = logs[0], np.asarray(logs[0].extra["action_x"]).copy()
    lost[np.flatnonzero(log.policy_step)[len(lost) // 20]] = np.nan
    some = windows(replace(log, extra={**log.extra, "action_x": lost}))
    assert 0 < len(some.pos_w) < len(windows(log).pos_w)
    assert np.isfinite(some.action_b).all() and np.isfinite(some.burn_in.inputs).all()


def test_windows_of_unlike_rates_are_cut_to_what_all_have():
    """A log of every other decision has half as many in a window, and in what came before it."""
    (log,) = flight()
    both = module.cut_windows([log, thinned(log)], 0.5, 0.3)
    assert both.action_b.shape[1] == both.pos_w.shape[1] - 1 == 8
    assert both.burn_in.seen.shape[1] == both.burn_in.inputs.shape[1] == 45
    # Rows of the whole log keep the latest of what came before them, not the first.
    alone = module.cut_windows([log], 0.5, 0.3).burn_in.seen
    np.testing.assert_array_equal(both.burn_in.seen[: len(alone)], alone[:, -45:])


@pytest.mark.parametrize("rate_hz", [15.0, 45.0, 90.0])
def test_the_period_of_decisions_that_stand_on_rows_is_that_of_the_policy(rate_hz):
    time = np.ceil(np.arange(0.0, 20.0, 1.0 / rate_hz) * 100 - 1e-9) / 100
    assert module.decision_period(time, 0.01) == pytest.approx(1.0 / rate_hz, rel=2e-3)
    gap = np.concatenate([time, time[-1] + 3.0 + time])
    assert module.decision_period(gap, 0.01) == pytest.approx(1.0 / rate_hz, rel=2e-3)
    assert np.isnan(module.decision_period(time[:1], 0.01))


def test_the_rate_of_flights_is_that_of_their_policy_and_decisions_in_a_row_are_near():
    first, *rest = flight(3)
    # Rates within 5 % of the median are one.
    for share in (1.0, 1.04):
        rate = module.decision_rate([replace(first, time_s=first.time_s * share), *rest])
        assert rate == pytest.approx(30.0, rel=1e-3)
    with pytest.raises(ValueError, match="fit to flights of one rate"):
        module.decision_rate([replace(first, time_s=first.time_s * 1.06), *rest])
    with pytest.raises(ValueError, match=r"has 15 decisions a second, and most flights 30"):
        module.decision_rate([thinned(first), *rest])
    found = module.are_consecutive(np.array([1.0, 1.99, 2.0]), period_s=1.0, row_s=0.5)
    np.testing.assert_array_equal(found, [True, True, False])


def test_a_burn_in_ends_at_the_window_and_is_blank_before_the_flight():
    still, vel_w = np.tile(np.eye(3), (5, 1, 1)), np.arange(15.0).reshape(5, 3)
    inputs, seen = module.burn_in_before(still, vel_w, -vel_w, first=2, count=3)
    np.testing.assert_array_equal(seen, [0, 1, 1])
    np.testing.assert_array_equal(inputs[0], np.zeros(9))
    np.testing.assert_array_equal(inputs[2], [*vel_w[1], 0, 0, 1, *-vel_w[1]])
    inputs, seen = module.burn_in_before(still, vel_w, -vel_w, first=4, count=3)
    assert seen.all()
    np.testing.assert_array_equal(inputs[:, :3], vel_w[1:4])


def test_what_was_not_seen_is_not_remembered_and_a_share_of_the_windows_forgets():
    params = delta_network.init(jax.random.key(1))
    inputs = np.random.default_rng(0).normal(size=(2, 4, 9))
    late = module.BurnIn(inputs, np.tile([0.0, 0.0, 1.0, 1.0], (2, 1)))
    assert not np.any(module.state_after(params, module.BurnIn(inputs, np.zeros((2, 4)))))
    assert not np.any(module.state_after(None, late))
    found, seen = module.state_after(params, late), module.BurnIn(inputs[:, 2:], late.seen[:, 2:])
    assert np.abs(found).max() > 1e-3
    np.testing.assert_array_equal(found, module.state_after(params, seen))
    inputs = np.ones((5, 3, 9))
    part = module.without_memory(module.BurnIn(inputs, np.ones((5, 3))), 0.4)
    np.testing.assert_array_equal(part.seen, [[0.0] * 3] * 2 + [[1.0] * 3] * 3)
    assert [module.without_memory(part, share).seen.sum() for share in (0.0, 1.0)] == [9.0, 0.0]
    np.testing.assert_array_equal(part.inputs, inputs)


def errors(plant, windows, delta=None):
    pos, vel, _ = jax.jit(replay_point_mass)(plant, windows, delta)
    return np.abs(pos - windows.pos_w[:, 1:]).max(), np.abs(vel - windows.vel_w[:, 1:]).max()


@pytest.mark.parametrize("delay", [more(0.0), 1.7])
def test_flights_of_the_point_mass_replay_as_they_were_flown(delay):
    """Rounding in float32 and the start's acceleration from velocities 1 ms apart."""
    plant = PointMassModel(np.float32(10.0), np.zeros(3, np.float32), np.float32(delay))
    windows = module.cut_windows(fly(plant), 1.0, 0.2)
    assert windows.action_b.shape[1:] == (30, 3) and len(windows.acc_w) > 20
    travelled = np.linalg.norm(windows.pos_w[:, -1] - windows.pos_w[:, 0], axis=-1)
    assert travelled.mean() > 1
    pos, vel = errors(plant, windows)
    assert pos < 2e-3 and vel < 5e-3
    for wrong in ({"delay": np.float32(delay + 0.3)}, {"lag": np.float32(8.0)}):
        assert errors(plant._replace(**wrong), windows)[0] > 10 * pos


def test_drag_at_the_start_is_that_of_the_step_before():
    """The log has the drag of now, the point mass that of a step ago: centimetres over 1 s."""
    plant = PointMassModel(np.float32(10.0), np.array([0.3, 0.4, 0.5], np.float32), np.float32(0.5))
    windows = module.cut_windows(fly(plant), 1.0, 0.2)
    pos, vel = errors(plant, windows)
    assert pos < 0.03 and vel < 0.03
    assert errors(plant._replace(drag=np.zeros(3, np.float32)), windows)[0] > 0.2


TRUE = with_effects(
    with_lag(PLAIN, 0.03),
    linear_drag=((0.2, 0.2, 0.5),),
    command_delay=(0.03,),
    com_offset=((0.01, -0.004, 0.0),),
)
BARE = replace(TRUE, effects={k: v for k, v in TRUE.effects.items() if k != "com_offset"})


@pytest.fixture(scope="module")
def logs():
    """Logs of four flights along gates that stand about, at 15 decisions a second."""
    tracks, found = {}, []
    for k in range(4):
        track = straight(distances=(4.0, 8.0, 40.0), height=8.0)
        gates = track.scene.gates
        gates = gates._replace(center_w=gates.center_w + [0.0, 1.5 * k - 2.0, 0.5 * k])
        tracks[f"course {k}"] = replace(track, scene=track.scene._replace(gates=gates))

    def keep(result, flight):
        found.append(log_from_flight(flight, f"{result.track}.parquet"))

    spec = PolicySpec(rate_hz=15.0, camera=Camera(width=8, height=8))
    pilot, trials = Pursuit(speed=3.0, gain=1.5, spec=spec), [TrialSpec(k, 0, 0) for k in tracks]
    options = judge.JudgeOptions(slots=4, workers=1, rules=Rules(time_limit_s=3.0))
    given = {"options": options, "on_result": keep, "record": judge.Record(), "tracks": tracks}
    judge.fly(pilot, trials, TRUE, **given)
    return found


def replayed(logs, config, horizon_s, stride_s):
    """Return windows of the logs, and a function (windows, network) that flies them again."""
    windows, cut = cut_quadrotor_windows(logs, config, horizon_s, stride_s)
    return windows, jax.jit(partial(replay_quadrotor, config, cut))


@pytest.fixture(scope="module")
def of_true(logs):
    """Return what `replayed` returns for the vehicle that was flown, and a second."""
    return replayed(logs, QuadrotorConfig(TRUE), 1.0, 0.3)


def test_flights_of_the_judge_replay_as_they_were_flown(logs, of_true):
    """Steps of 5 ms for the judge's 2 ms: centimetres after a second."""
    windows, replay = of_true
    pos, vel = map(np.asarray, window_errors(replay, windows, None))
    moved = np.linalg.norm(windows.pos_w[:, -1] - windows.pos_w[:, 0], axis=-1)
    assert len(pos) > 12 and np.median(moved) > 1
    assert pos.max() < 0.05 and vel.max() < 0.1
    _, replay = replayed(logs, QuadrotorConfig(BARE), 1.0, 0.3)
    assert np.median(window_errors(replay, windows, None)[0]) > 10 * np.median(pos)


def test_windows_start_at_decisions_with_what_was_under_way(logs):
    config = QuadrotorConfig(TRUE)
    windows, cut = cut_quadrotor_windows(logs, config, 0.5, 0.3)
    assert cut == (1, 2, pytest.approx(0.005))
    assert np.all(windows.decides[:, 0] == 1)
    assert windows.decides.sum(1).min() >= 7 and windows.decides.sum(1).max() <= 8
    log = logs[0]
    first = int(np.searchsorted(log.time_s, windows.start_s[0] + 1e-4)) - 1
    np.testing.assert_allclose(windows.pos_w[0, 0], log.pos_w[first], atol=1e-5)
    np.testing.assert_allclose(windows.rotor_speed[0], log.rotor_speed[first], rtol=1e-6)
    # 30 ms of delay are 6 steps of 5 ms: the row before the start twice, newest first.
    rows = first - 1 - np.arange(6) // 2
    np.testing.assert_allclose(windows.past[0, :6, 0], log.thrust_cmd[rows], rtol=1e-6)
    np.testing.assert_allclose(windows.past[0, :6, 1:], log.rate_cmd_b[rows], atol=1e-6)


def test_commands_before_a_window_are_never_those_of_the_flights_end(logs):
    """The rows before the first window follow fast: a step may be longer ago than the first row."""
    config = QuadrotorConfig(TRUE)
    usual = cut_quadrotor_windows(logs[:1], config, 0.5, 5.0)[0]
    begin = int(np.flatnonzero(logs[0].policy_step)[1]) - 4
    kept = np.arange(len(logs[0].time_s)) >= begin
    extra = {name: np.asarray(column)[kept] for name, column in logs[0].extra.items()}
    log = replace(rows(logs[0], kept), extra=extra)
    log.time_s[:4] = log.time_s[4] - 0.0081 * np.arange(4, 0, -1)
    past = cut_quadrotor_windows([log], config, 0.5, 5.0)[0].past
    assert past.shape == usual.past.shape == (1, 7, 4)
    assert past[0, -1, 0] == pytest.approx(log.thrust_cmd[0], rel=1e-6)


@pytest.fixture(scope="module")
def of_point_mass():
    replay = jax.jit(partial(replay_point_mass, nominal_model(PointMassConfig())))
    return module.cut_windows(flight(4), 0.5, 0.3), replay


@pytest.mark.parametrize(
    ("model", "rtol"),
    [("of_point_mass", 0.0), more("of_true", 1e-6)],
)
def test_a_fresh_delta_changes_nothing_and_a_constant_one_acts_as_the_action(model, rtol, request):
    """With and without it are two programs, which may round otherwise in the last digit or two."""
    windows, replay = request.getfixturevalue(model)
    push, delta = np.array([1.0, -0.5, 0.2], np.float32), delta_network.init(jax.random.key(0))
    fresh = replay(windows, delta)
    np.testing.assert_allclose(replay(windows, None)[0], fresh[0], rtol=rtol)
    assert not np.any(fresh[2])
    delta["output.bias"] = jnp.asarray(push)
    pos, _, correction = replay(windows, delta)
    np.testing.assert_allclose(correction, np.broadcast_to(push, correction.shape), rtol=rtol)
    shifted = replay(windows._replace(action_b=windows.action_b + push), None)[0]
    np.testing.assert_allclose(pos, shifted, atol=1e-5)


def test_the_network_remembers_the_flight_before_a_window(logs):
    """The state before a window is that of the network run over the flight's decisions."""
    params = delta_network.init(jax.random.key(1))
    windows = cut_quadrotor_windows(logs[:1], QuadrotorConfig(TRUE), 0.5, 0.3)[0]
    hidden = np.asarray(jax.jit(module.state_after)(params, windows.burn_in))
    log, number, step = logs[0], 3, jax.jit(delta_network.step)
    at = np.flatnonzero(log.policy_step)
    at = at[log.time_s[at] < windows.start_s[number] - 1e-4]
    state = delta_network.start(1)
    for row in at[-45:]:
        vel_b = log.rot_w[row].T @ log.vel_w[row]
        inputs = (vel_b, log.rot_w[row][2], log.action_b[row])
        state = step(params, state, *(x[None] for x in inputs))[1]
    np.testing.assert_allclose(hidden[number], state[0], atol=1e-5)
    assert np.abs(hidden[number]).max() > 1e-2


@pytest.mark.slow
def test_a_fit_cuts_the_error_and_says_what_it_corrects(logs, tmp_path, monkeypatch):
    """As many flights are held out as are fitted: the errors of both are one program."""
    monkeypatch.setattr(quadrotor, "LEAST_PHYSICS_HZ", 100.0)  # a step a row compiles faster
    config = FitConfig(horizon_s=0.5, iterations=30, batch=32, rate=1e-2, held_out=0.5)
    quad = QuadrotorConfig(BARE, physics_hz=100.0)
    result = run.fit_delta(config, quad, CheckedFlights(logs), tmp_path / "out", Console())
    assert result.errors["without"].position_m > 0.05
    assert result.errors["delta_action"].position_m < 0.6 * result.errors["without"].position_m
    stored = load_delta(tmp_path / "out" / "delta")
    assert stored.config["fit"]["model"] == "quad"
    for name, value in result.params.items():
        np.testing.assert_array_equal(stored.arrays[name], value)
    assert "| quadrotor with Delta Action Model |" in (tmp_path / "out" / "table.md").read_text()


@pytest.mark.extended
def test_a_firmwares_rate_loop_replays_too(logs):
    """Its memory is of the loop, which looks for the first time where a window starts."""
    windows, replay = replayed(logs[:1], QuadrotorConfig(load_vehicle("crazyflie21")), 0.5, 0.3)
    pos_w, vel_w, _ = replay(windows, None)
    assert np.all(np.isfinite(pos_w)) and np.all(np.isfinite(vel_w))


def test_windows_of_two_parts_have_one_grid(logs):
    """A log with rows of another length than most has no windows, instead of wrong ones."""
    slow = replace(logs[0], time_s=2.0 * logs[0].time_s)
    config = QuadrotorConfig(TRUE)
    row_s = row_period([*logs[1:], slow])
    assert row_s == pytest.approx(0.01)
    with pytest.raises(ValueError, match="no window of 0.5 s .* has all values"):
        cut_quadrotor_windows([slow], config, 0.5, 0.3, row_s)
    words: list[str] = []
    cut_quadrotor_windows([*logs[1:], slow], config, 0.5, 0.3, row_s, words.append)
    assert len(words) == 1 and words[0].startswith(f"{slow.name}: not used")
    with pytest.raises(ValueError, match="action_x.*suite collect"):
        cut_quadrotor_windows([replace(logs[0], extra={})], config, 0.5, 0.3)
    assert len(cut_quadrotor_windows([slow], config, 0.5, 0.3)[0].pos_w) > 0


@pytest.mark.extended
def test_a_load_on_a_line_hangs_still_where_a_window_starts_and_then_swings(logs):
    own = {name: tuple(values) for name, values in TRUE.effects.items()}
    loaded = QuadrotorConfig(with_effects(TRUE, **own, slung_load=(0.1, 0.5)))
    windows, replay = replayed(logs[:1], loaded, 0.5, 0.5)
    sunk = np.asarray(replay(windows, None)[0])[:, -1, 2] - windows.pos_w[:, -1, 2]
    # 0.1 kg under 0.75 kg that nobody lifts more for: g m / (M + m) t^2 / 2.
    np.testing.assert_allclose(sunk, -0.5 * 9.81 * 0.1 / 0.85 * 0.5**2, rtol=0.3)

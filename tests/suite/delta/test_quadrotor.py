"""Flights of the judge cut into windows and flown again in the trainer's quadrotor."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.judging.judge import JudgeOptions, Record, fly
from eval.logs.flight_log import log_from_flight, write_flight
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules, TrialSpec
from policies.formats.policy_file import load_delta
from policies.networks import delta_network
from policies.spec import PolicySpec
from suite.common.console import Console
from suite.delta import quadrotor
from suite.delta.fit import FitConfig, window_errors
from suite.delta.quadrotor import cut_quadrotor_windows, replay_quadrotor, row_period
from suite.delta.run import fit_delta
from suite.delta.windows import state_after
from suite.train.config import QuadrotorConfig
from tests.support.courses import straight
from tests.support.pilots import Pursuit
from tests.support.vehicles import PLAIN, with_effects, with_lag
from tracks.geometry.camera import Camera

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
    tracks = {}
    for k in range(4):
        track = straight(distances=(4.0, 8.0, 40.0), height=8.0)
        gates = track.scene.gates
        center = gates.center_w + [0.0, 1.5 * k - 2.0, 0.5 * k]
        scene = track.scene._replace(gates=gates._replace(center_w=center))
        tracks[f"course {k}"] = replace(track, scene=scene)
    found = []

    def keep(result, flight):
        found.append(log_from_flight(flight, f"{result.track}.parquet"))

    spec = PolicySpec(rate_hz=15.0, camera=Camera(width=8, height=8))
    pilot, trials = Pursuit(speed=3.0, gain=1.5, spec=spec), [TrialSpec(k, 0, 0) for k in tracks]
    options = JudgeOptions(slots=4, workers=1, rules=Rules(time_limit_s=3.0))
    fly(pilot, trials, TRUE, options=options, on_result=keep, record=Record(), tracks=tracks)
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


def test_a_constant_delta_acts_as_the_action(of_true):
    push = np.array([1.0, -0.5, 0.2], np.float32)
    windows, replay = of_true
    delta = delta_network.init(jax.random.key(0))
    # Two programs, which round alike to the last digit or two.
    np.testing.assert_allclose(replay(windows, None)[0], replay(windows, delta)[0], rtol=1e-6)
    delta["output.bias"] = jnp.asarray(push)
    pos, _, correction = replay(windows, delta)
    np.testing.assert_allclose(correction, np.broadcast_to(push, correction.shape), rtol=1e-6)
    shifted = replay(windows._replace(action_b=windows.action_b + push), None)[0]
    np.testing.assert_allclose(pos, shifted, atol=1e-5)


def test_the_network_remembers_the_flight_before_a_window(logs):
    """The state before a window is that of the network run over the flight's decisions."""
    params = delta_network.init(jax.random.key(1))
    windows = cut_quadrotor_windows(logs[:1], QuadrotorConfig(TRUE), 0.5, 0.3)[0]
    hidden = np.asarray(jax.jit(state_after)(params, windows.burn_in))
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


def test_a_fit_cuts_the_error_and_says_what_it_corrects(logs, tmp_path, monkeypatch):
    """As many flights are held out as are fitted: the errors of both are one program."""
    monkeypatch.setattr(quadrotor, "LEAST_PHYSICS_HZ", 100.0)  # a step a row compiles faster
    for log in logs:
        write_flight(tmp_path / "logs" / log.name.replace(" ", "-"), log)
    config = FitConfig(horizon_s=0.5, iterations=30, batch=32, rate=1e-2, held_out=0.5)
    quad = QuadrotorConfig(BARE, physics_hz=100.0)
    result = fit_delta(config, quad, [tmp_path / "logs"], tmp_path / "out", Console())
    assert result.errors["without"].position_m > 0.05
    assert result.errors["delta_action"].position_m < 0.6 * result.errors["without"].position_m
    stored = load_delta(tmp_path / "out" / "delta")
    assert stored.config["fit"]["model"] == "quad"
    for name, value in result.params.items():
        np.testing.assert_array_equal(stored.arrays[name], value)
    assert "| quadrotor with Delta Action Model |" in (tmp_path / "out" / "table.md").read_text()


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
    with pytest.raises(ValueError, match="no window of 0.5 s"):
        cut_quadrotor_windows([slow], config, 0.5, 0.3, row_s)
    with pytest.raises(ValueError, match="action_x.*suite collect"):
        cut_quadrotor_windows([replace(logs[0], extra={})], config, 0.5, 0.3)
    assert len(cut_quadrotor_windows([slow], config, 0.5, 0.3)[0].pos_w) > 0


def test_a_load_on_a_line_hangs_still_where_a_window_starts_and_then_swings(logs):
    own = {name: tuple(values) for name, values in TRUE.effects.items()}
    loaded = QuadrotorConfig(with_effects(TRUE, **own, slung_load=(0.1, 0.5)))
    windows, replay = replayed(logs[:1], loaded, 0.5, 0.5)
    sunk = np.asarray(replay(windows, None)[0])[:, -1, 2] - windows.pos_w[:, -1, 2]
    # 0.1 kg under 0.75 kg that nobody lifts more for: g m / (M + m) t^2 / 2.
    np.testing.assert_allclose(sunk, -0.5 * 9.81 * 0.1 / 0.85 * 0.5**2, rtol=0.3)

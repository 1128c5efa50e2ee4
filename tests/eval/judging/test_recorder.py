"""Flights gathered slot by slot: rows worked by hand, and a flight that fits its trial."""

import numpy as np
import pytest

from eval.judging.judge import JudgeOptions, Record, fly
from eval.judging.recorder import Recorder
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds import Rows
from eval.worlds.trial import Rules, TrialSpec
from tests.support.pilots import RandomNetwork

VEHICLE = load_vehicle("reference")


def rows(due, time_s):
    """Rows of two slots: the numbers of slot 1 are those of slot 0 and ten more."""
    add = np.array([0.0, 10.0])
    three, four = (np.arange(size) + add[:, None] for size in (3, 4))
    return Rows(
        due=np.asarray(due),
        time_s=np.asarray(time_s, dtype=float),
        pos_w=three,
        quat_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)),
        vel_w=three,
        rate_b=three,
        thrust_cmd=9.81 + add,
        rate_cmd_b=three,
        rotor_speed=four,
        gate=(add + 2).astype(int),
    )


def test_slots_do_not_mix_and_a_decision_is_flagged_once():
    recorder = Recorder(2, depth=True)
    action_b = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    depth_m = np.stack([np.full((2, 2), 7.0), np.full((2, 2), 8.0)])
    recorder.add(rows([True, True], [0.0, 0.5]))
    recorder.decided(np.array([1]), action_b, depth_m)
    recorder.add(rows([False, True], [0.1, 0.6]))
    recorder.add(rows([True, True], [0.2, 0.7]))
    first, second = recorder.finish(0, {"seed": 3}), recorder.finish(1, {"seed": 4})
    assert first.about == {"seed": 3} and second.about == {"seed": 4}
    np.testing.assert_array_equal(first.time_s, [0.0, 0.2])
    np.testing.assert_array_equal(second.time_s, [0.5, 0.6, 0.7])
    np.testing.assert_array_equal(second.pos_w, np.tile([10.0, 11.0, 12.0], (3, 1)))
    np.testing.assert_array_equal(second.rotor_speed, np.tile([10.0, 11.0, 12.0, 13.0], (3, 1)))
    np.testing.assert_array_equal(second.gate, [12, 12, 12])
    assert second.policy_step.tolist() == [False, True, False] and not first.policy_step.any()
    np.testing.assert_array_equal(second.action_b, [[0, 0, 0], [4, 5, 6], [4, 5, 6]])
    assert second.depth_m is not None and first.depth_m is not None
    assert second.depth_m.dtype == np.float32 and len(first.depth_m) == 0
    np.testing.assert_array_equal(second.depth_m, depth_m[1:])


def test_the_next_trial_of_a_slot_begins_with_nothing():
    recorder = Recorder(2, depth=False)
    recorder.decided(np.array([0]), np.ones((2, 3)), np.zeros((2, 2, 2)))
    recorder.add(rows([True, True], [0.0, 0.0]))
    recorder.start(0)
    empty = recorder.finish(0, {})
    assert (empty.time_s.shape, empty.quat_wxyz.shape, empty.depth_m) == ((0,), (0, 4), None)
    recorder.add(rows([True, False], [0.0, 0.0]))
    (action,) = recorder.finish(0, {}).action_b
    np.testing.assert_array_equal(action, np.zeros(3))


def test_recording_changes_nothing():
    levels = ((track, level) for track in ("zigzag", "circular") for level in (1, 6))
    trials = [TrialSpec(track, level, 0) for track, level in levels]
    options, flights = JudgeOptions(slots=3, rules=Rules(time_limit_s=1.0)), {}
    policy = RandomNetwork()
    found = fly(
        policy, trials, VEHICLE, "mujoco", options,
        on_result=lambda result, flight: flights.update({result.trial: flight}),
        record=Record(depth=True),
    )  # fmt: skip
    assert found == fly(policy, trials, VEHICLE, "mujoco", options)
    for result in found:
        check_flight(flights[result.trial], result)


def check_flight(flight, result):
    rows = len(flight.time_s)
    assert np.diff(flight.time_s).min() > 0 and flight.time_s[0] == 0.0
    assert np.allclose(np.diff(flight.time_s)[:-1], 0.01)
    assert flight.time_s[-1] == pytest.approx(result.time_s)
    assert np.array_equal(flight.pos_w[-1], [result.pos_x, result.pos_y, result.pos_z])
    assert (flight.gate[-1], flight.about["ended_by"]) == (result.gates_passed, result.ended_by)
    assert {len(part) for part in flight[:-2]} == {rows}
    # 30 decisions a second, the first at once; each has its image.
    assert flight.policy_step[0] and flight.policy_step.sum() == len(flight.depth_m)
    assert abs(flight.policy_step.sum() - 30 * result.time_s) <= 1.5
    # The action in use changes where a decision is flagged and nowhere else.
    changed = (np.diff(flight.action_b, axis=0) != 0).any(-1)
    assert not changed[~flight.policy_step[1:]].any()
    # Velocity is the position's slope, and hovering rotors carry the weight at the start.
    slope = np.gradient(flight.pos_w, flight.time_s, axis=0)
    assert np.abs(slope - flight.vel_w)[2:-2].max() < 0.1
    assert 4 * 1.6e-6 * (flight.rotor_speed[0] ** 2).mean() > 0

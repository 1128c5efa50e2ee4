"""A trial's outcome is set by (track, difficulty, seed) alone, to the bit."""

import numpy as np
import pytest

from eval.judging.judge import JudgeOptions, Record, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules, TrialSpec
from tests.support.pilots import Pursuit, RandomNetwork

VEHICLE = load_vehicle("reference")
TRIALS = [
    TrialSpec(track, level, seed)
    for track in ("zigzag", "circular", "ellipse")
    for level in (1, 6)
    for seed in (0, 1)
]
RULES = Rules(time_limit_s=2.0)


def results(trials, slots=64, threads=1, processes=1, policy=None):
    options = JudgeOptions(slots, threads, processes, RULES)
    return fly(policy or network(), trials, VEHICLE, "mujoco", options)


_made = {}


def network():
    return _made.setdefault("network", RandomNetwork())


@pytest.fixture(scope="module")
def expected():
    found = dict(zip(TRIALS, results(TRIALS), strict=True))
    # Something must be going on: not all the same end, all the same numbers.
    assert len({result.v_max for result in found.values()}) == len(TRIALS)
    return found


def same(trials, found, expected):
    assert [result.trial for result in found] == list(trials)
    assert found == [expected[trial] for trial in trials]


def test_repeats(expected):
    same(TRIALS, results(TRIALS), expected)


def test_order_and_subset(expected):
    order = [TRIALS[i] for i in np.random.default_rng(1).permutation(len(TRIALS))][:7]
    same(order, results(order), expected)


def test_alone(expected):
    same(TRIALS[5:6], results(TRIALS[5:6]), expected)


@pytest.mark.parametrize("slots", [3, 20])
def test_number_of_slots(expected, slots):
    # With 3 slots trials start in the middle of others, each in any slot.
    same(TRIALS, results(TRIALS, slots), expected)


def test_threads(expected):
    same(TRIALS, results(TRIALS, slots=5, threads=2), expected)


def test_processes(expected):
    policy = RandomNetwork  # made anew in each process
    same(TRIALS[:6], results(TRIALS[:6], processes=2, policy=policy), expected)


def test_recording_changes_nothing(expected):
    flights = {}
    options = JudgeOptions(slots=4, rules=RULES, processes=1)
    found = fly(
        network(), TRIALS[:5], VEHICLE, "mujoco", options,
        on_result=lambda result, flight: flights.update({result.trial: flight}),
        record=Record(depth=True),
    )  # fmt: skip
    same(TRIALS[:5], found, expected)
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


def test_pursuit_by_a_scripted_policy_is_deterministic_too():
    first = results(TRIALS[:4], slots=2, policy=Pursuit())
    assert first == results(TRIALS[:4], slots=64, policy=Pursuit())


def test_reference_world_flies_the_same(expected):
    trials = TRIALS[3::4]
    options = JudgeOptions(rules=RULES)
    found = fly(network(), trials, VEHICLE, "reference", options)
    assert [r._replace(world="mujoco") for r in found] == [expected[t] for t in trials]

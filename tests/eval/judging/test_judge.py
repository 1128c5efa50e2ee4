"""The judge: wrong input, interrupts, recordings, and outcomes that are the trial's alone."""

import multiprocessing
from dataclasses import replace

import numpy as np
import pytest

from eval.judging.judge import JudgeOptions, Record
from eval.judging.recorder import Recorder
from eval.judging.results import Journal
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds import WORLDS, Rows
from eval.worlds.mujoco import MujocoWorld
from eval.worlds.trial import Rules, TrialSpec
from policies.spec import PolicySpec
from tests.support.courses import fly_on, straight
from tests.support.marks import more
from tests.support.pilots import Pursuit, Steady, random_network
from tests.support.reference import assert_alike, fly
from tracks.formats.custom import load_track

VEHICLE = load_vehicle("reference")
SHORT = Rules(time_limit_s=0.2)


def test_unknown_names_are_refused_before_anything_flies():
    with pytest.raises(ValueError, match=r"unknown simulator 'mujoko'.*Did you mean 'mujoco'"):
        fly(Pursuit(), [TrialSpec("zigzag", 0, 0)], VEHICLE, "mujoko")
    with pytest.raises(ValueError, match="zigzac"):
        fly(Pursuit(), [TrialSpec("zigzac", 0, 0)], VEHICLE)


@pytest.mark.parametrize(
    ("rate_hz", "message"),
    [(0.0, "spec.rate_hz is 0"), (501.0, "allowed is 1 to 500"), (300.0, "decides at 300 Hz")],
)
def test_a_policy_that_cannot_keep_time_is_refused(rate_hz, message):
    policy = Steady(spec=PolicySpec(rate_hz=rate_hz))
    slow = replace(VEHICLE, controller=replace(VEHICLE.controller, frequency=250.0))
    with pytest.raises(ValueError, match=message):
        fly(policy, [TrialSpec("zigzag", 0, 0)], slow)


def test_without_trials_nothing_flies():
    assert fly(Pursuit(), [], VEHICLE) == []


def test_tracks_with_meshes_are_flown_beside_others(root):
    yard = load_track(root / "tracks" / "examples" / "yard.toml")
    trials = [TrialSpec(name, 0, 0) for name in ("zigzag", "yard", "zigzag")]
    results = fly(
        Steady(), trials, VEHICLE, options=JudgeOptions(rules=SHORT), tracks={"yard": yard}
    )
    assert [result.track for result in results] == ["zigzag", "yard", "zigzag"]
    assert results[0] == results[2]


@pytest.mark.parametrize("rate_hz", [7.0, more(30.0), more(100.0), 500.0])
def test_decisions_come_at_the_policys_rate(rate_hz):
    policy, end_s = Steady(spec=PolicySpec(rate_hz=rate_hz)), 1.0 if rate_hz < 100 else 0.3
    how = {"record": Record(depth=True), "rules": Rules(time_limit_s=end_s)}
    _, (flight,) = fly_on(policy, straight(), vehicle=VEHICLE, **how)
    # A decision shows in the first row that flies it; rows are 100 a second.
    expected = {round(k * 500 / rate_hz) for k in range(int(rate_hz) + 1)}
    expected = {step for step in expected if step < 500 * end_s}
    # An image has the time of its decision, even between rows or twice in a row.
    np.testing.assert_allclose(flight.depth_time_s, np.sort(list(expected)) / 500)
    assert len(flight.depth_m) == len(expected)
    rows = {-(-step // 5) for step in expected}
    found = {round(t * 100) for t in flight.time_s[flight.policy_step]}
    assert found | {100 * end_s} == rows | {100 * end_s}


class Interrupt:
    """Raises what Ctrl-C does at the third result."""

    def __init__(self, journal):
        self.journal = journal

    def __call__(self, result, flight):
        self.journal.append(result)
        if len(self.journal.done) == 3:
            raise KeyboardInterrupt


@pytest.mark.parametrize("workers", [more(1), 2])
def test_interrupt_keeps_what_was_finished_and_the_rest_is_flown_later(tmp_path, workers):
    trials = [TrialSpec("zigzag", 3, seed) for seed in range(6)]
    options = JudgeOptions(slots=2, rules=SHORT, workers=workers)
    expected = fly(Pursuit(), trials, VEHICLE, options=JudgeOptions(rules=SHORT))
    path, about = tmp_path / "journal", {"policy": "pursuit"}
    policy = Pursuit() if workers == 1 else Pursuit  # made anew in each process
    with Journal(path, about) as journal, pytest.raises(KeyboardInterrupt):
        fly(policy, trials, VEHICLE, options=options, on_result=Interrupt(journal))
    assert multiprocessing.active_children() == []
    with Journal(path, about) as journal:
        left = journal.missing(trials)
        assert len(left) == 3
        options = JudgeOptions(slots=2, rules=SHORT)
        fly(Pursuit(), left, VEHICLE, options=options, on_result=lambda r, _: journal.append(r))
        assert [journal.done[trial] for trial in trials] == expected


TRIALS = [
    TrialSpec(track, level, 0) for track in ("zigzag", "circular", "ellipse") for level in (1, 6)
]
RULES = Rules(time_limit_s=0.3)


def results(trials, slots=64, threads=1, world="mujoco"):
    options = JudgeOptions(slots, threads, rules=RULES)
    return fly(random_network(), trials, VEHICLE, world, options)


@pytest.fixture(scope="module")
def expected():
    found = dict(zip(TRIALS, results(TRIALS), strict=True))
    # Something must be going on: not all the same end, all the same numbers.
    assert len({result.v_max for result in found.values()}) == len(TRIALS)
    return found


def same(trials, found, expected):
    assert [result.trial for result in found] == list(trials)
    assert found == [expected[trial] for trial in trials]


def test_outcomes_are_the_same_at_any_order_number_of_slots_and_threads(expected):
    same(TRIALS[5:1:-2], results(TRIALS[5:1:-2]), expected)
    # With 3 slots trials start in the middle of others, each in any slot.
    same(TRIALS, results(TRIALS, slots=3, threads=2), expected)


def test_a_world_that_compiles_has_the_same_slots_for_any_number_of_trials(monkeypatch):
    """Another number of slots would be another program, with other rounding."""
    slots = set()

    def make(*arguments, **settings):
        slots.add(settings["slots"])
        return MujocoWorld(*arguments, **settings)

    make.compiles = True
    monkeypatch.setitem(WORLDS._values, "compiling", make)
    monkeypatch.setitem(WORLDS._entries, "compiling", make)
    for trials in TRIALS[:1], TRIALS[:3]:
        found = results(trials, slots=70, world="compiling")
        assert {result.world for result in found} == {"compiling"}  # not the name of what it wraps
    assert slots == {70}


def test_reference_world_flies_the_same(expected):
    trials = TRIALS[1::2]
    found = results(trials, world="reference")
    for trial, result in zip(trials, found, strict=True):
        assert_alike(result._replace(world="mujoco"), expected[trial])


def test_a_trial_that_ends_at_its_start_makes_no_decision():
    for world in ("mujoco", "reference"):
        ends = fly_on(
            Pursuit(), straight(wall_at=0.0, name="blocked"), straight(name="free"),
            vehicle=VEHICLE, world=world, slots=1, workers=1, rules=RULES,
        )[0]  # fmt: skip
        found = [(end.ended_by, end.decisions) for end in ends]
        assert found == [("collision", 0), ("timeout", 9)], world
        assert (ends[0].time_s, ends[0].collided_with, ends[0].v_max) == (0.0, "the wall", 0.0)


def rows(due, time_s):
    """Rows of two slots without a number twice: 100 a field, 10 a slot, 1 a component."""
    starts = [100.0 * k + np.array([[0.0], [10.0]]) for k in range(8)]
    sizes = (3, 4, 3, 3, 1, 3, 4, 1)
    parts = [start + np.arange(size) for start, size in zip(starts, sizes, strict=True)]
    return Rows(np.asarray(due), np.asarray(time_s), *(np.squeeze(part) for part in parts))


def test_slots_and_fields_do_not_mix_and_a_decision_is_flagged_once():
    recorder = Recorder(2, True, np.zeros(3), "acceleration")
    action_b, depth_m = np.arange(6.0).reshape(2, 3), np.arange(8.0).reshape(2, 2, 2)
    recorder.add(rows([True, True], [0.0, 0.5]))
    recorder.decided(np.array([1]), np.array([0.1, 0.58]), action_b, depth_m)
    recorder.add(rows([False, True], [0.1, 0.6]))
    recorder.add(rows([True, True], [0.2, 0.7]))
    first, second = recorder.finish(0, {"seed": 3}), recorder.finish(1, {"seed": 4})
    assert (first.about, second.about) == ({"seed": 3}, {"seed": 4})
    np.testing.assert_array_equal(first.time_s, [0.0, 0.2])
    np.testing.assert_array_equal(second.time_s, [0.5, 0.6, 0.7])
    for slot, flight in enumerate((first, second)):
        for name, value in rows([True, True], [0.0, 0.0])._asdict().items():
            if name not in ("due", "time_s"):
                wanted = np.stack([value[slot]] * len(flight.time_s))
                np.testing.assert_array_equal(getattr(flight, name), wanted, err_msg=name)
    assert second.policy_step.tolist() == [False, True, False] and not first.policy_step.any()
    np.testing.assert_array_equal(second.action_b, [0 * action_b[1], action_b[1], action_b[1]])
    assert second.depth_m.dtype == np.float32 and len(first.depth_m) == 0
    np.testing.assert_array_equal(second.depth_m, depth_m[1:])
    assert (second.depth_time_s, len(first.depth_time_s)) == ([0.58], 0)


def test_the_next_trial_of_a_slot_begins_with_nothing():
    recorder = Recorder(2, False, np.zeros(3), "acceleration")
    recorder.decided(np.array([0]), np.zeros(2), np.ones((2, 3)), np.zeros((2, 2, 2)))
    recorder.add(rows([True, True], [0.0, 0.0]))
    recorder.start(0)
    empty = recorder.finish(0, {})
    assert (empty.time_s.shape, empty.quat_wxyz.shape, empty.depth_m) == ((0,), (0, 4), None)
    recorder.add(rows([True, False], [0.0, 0.0]))
    (action,) = recorder.finish(0, {}).action_b
    np.testing.assert_array_equal(action, np.zeros(3))


def test_recording_changes_nothing():
    options, flights = JudgeOptions(slots=3, rules=RULES), {}
    trials, policy = TRIALS[:4], random_network()
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
    assert {len(part) for part in flight[:-4]} == {rows}
    # 30 decisions a second, the first at once; each has its image.
    assert flight.policy_step[0] and flight.policy_step.sum() == len(flight.depth_m)
    assert abs(flight.policy_step.sum() - 30 * result.time_s) <= 1.5
    # The action in use changes where a decision is flagged and nowhere else.
    changed = (np.diff(flight.action_b, axis=0) != 0).any(-1)
    assert not changed[~flight.policy_step[1:]].any()
    # Velocity is the position's slope, and hovering rotors carry the weight at the start.
    slope = np.gradient(flight.pos_w, flight.time_s, axis=0)
    assert np.abs(slope - flight.vel_w)[2:-2].max() < 0.1
    thrust = VEHICLE.rotors.thrust_coefficient * (flight.rotor_speed[0] ** 2).sum()
    assert thrust == pytest.approx(VEHICLE.mass * 9.81, rel=1e-6)

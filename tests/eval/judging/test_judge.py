"""The judge: wrong input, interrupts, and outcomes that are the trial's alone, to the bit."""

import multiprocessing

import numpy as np
import pytest

from eval.judging.judge import JudgeOptions, Record, fly
from eval.judging.results import Journal
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules, TrialSpec
from policies.spec import PolicySpec
from tests.support.courses import straight
from tests.support.pilots import Pursuit, RandomNetwork, Steady
from tracks.formats.custom import load_track

VEHICLE = load_vehicle("reference")

SHORT = Rules(time_limit_s=0.3)


def test_unknown_names_are_refused_before_anything_flies():
    with pytest.raises(ValueError, match=r"unknown simulator 'mujoko'.*Did you mean 'mujoco'"):
        fly(Pursuit(), [TrialSpec("zigzag", 0, 0)], VEHICLE, "mujoko")
    with pytest.raises(ValueError, match="zigzac"):
        fly(Pursuit(), [TrialSpec("zigzac", 0, 0)], VEHICLE)


@pytest.mark.parametrize("rate_hz", [0.0, -5.0, 501.0])
def test_a_policy_that_cannot_keep_time_is_refused(rate_hz):
    policy = Steady(spec=PolicySpec(rate_hz=rate_hz))
    for world in ("mujoco", "reference"):
        with pytest.raises(ValueError, match="decides at"):
            fly(policy, [TrialSpec("zigzag", 0, 0)], VEHICLE, world)


def test_the_reference_world_records_nothing():
    with pytest.raises(ValueError, match="records no flights"):
        fly(Pursuit(), [TrialSpec("zigzag", 0, 0)], VEHICLE, "reference", record=Record())


def test_no_trials():
    assert fly(Pursuit(), [], VEHICLE) == []


def test_a_policy_is_asked_for_no_more_rows_than_there_are_trials():
    asked = []

    class Counted(Steady):
        def act(self, hidden, state, image, fresh):
            asked.append(len(state))
            return super().act(hidden, state, image, fresh)

    trials = [TrialSpec("zigzag", 0, seed) for seed in range(3)]
    fly(Counted(), trials, VEHICLE, options=JudgeOptions(rules=SHORT))
    assert set(asked) == {3}


def test_tracks_with_meshes_are_flown_beside_others(root):
    yard = load_track(root / "tracks" / "examples" / "yard.toml")
    trials = [TrialSpec(name, 0, 0) for name in ("zigzag", "yard", "zigzag")]
    results = fly(
        Steady(), trials, VEHICLE, options=JudgeOptions(rules=SHORT), tracks={"yard": yard}
    )
    assert [result.track for result in results] == ["zigzag", "yard", "zigzag"]
    assert results[0] == results[2]


@pytest.mark.parametrize("rate_hz", [7.0, 30.0, 100.0, 500.0])
def test_decisions_come_at_the_policys_rate(rate_hz):
    flights = []
    options = JudgeOptions(slots=2, rules=Rules(time_limit_s=1.0))
    trials = [TrialSpec("straight", 0, 0)]
    fly(
        Steady(spec=PolicySpec(rate_hz=rate_hz)), trials, VEHICLE, "mujoco", options,
        lambda result, flight: flights.append(flight), Record(), {"straight": straight()},
    )  # fmt: skip
    # A decision shows in the first row that flies it; rows are 100 a second.
    expected = {round(k * 500 / rate_hz) for k in range(int(rate_hz) + 1)}
    rows = {-(-step // 5) for step in expected if step < 500}
    found = {round(t * 100) for t in flights[0].time_s[flights[0].policy_step]}
    assert found | {100} == rows | {100}


class Interrupt:
    """Raises what Ctrl-C does at the third result."""

    def __init__(self, journal):
        self.journal = journal

    def __call__(self, result, flight):
        self.journal.append(result)
        if len(self.journal.done) == 3:
            raise KeyboardInterrupt


@pytest.mark.parametrize("workers", [1, 2])
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

RULES = Rules(time_limit_s=0.5)


def results(trials, slots=64, threads=1):
    options = JudgeOptions(slots, threads, rules=RULES)
    return fly(network(), trials, VEHICLE, "mujoco", options)


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


def test_repetition_order_subset_and_threads(expected):
    order = [TRIALS[i] for i in np.random.default_rng(1).permutation(len(TRIALS))][:4]
    same(order, results(order), expected)
    same(TRIALS[5:6], results(TRIALS[5:6]), expected)
    same(TRIALS, results(TRIALS, slots=5, threads=2), expected)


@pytest.mark.parametrize("slots", [3, 20])
def test_number_of_slots(expected, slots):
    # With 3 slots trials start in the middle of others, each in any slot.
    same(TRIALS, results(TRIALS, slots), expected)


def test_reference_world_flies_the_same(expected):
    trials = TRIALS[1::2]
    options = JudgeOptions(rules=RULES)
    found = fly(network(), trials, VEHICLE, "reference", options)
    assert [r._replace(world="mujoco") for r in found] == [expected[t] for t in trials]

"""The judge's doors: wrong input, interrupts, processes, recording."""

import multiprocessing

import pytest

from eval.judging.judge import JudgeOptions, Record, fly
from eval.judging.results import Journal
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules, TrialSpec
from policies.spec import PolicySpec
from tests.support.courses import straight
from tests.support.pilots import Pursuit, Steady

VEHICLE = load_vehicle("reference")
SHORT = Rules(time_limit_s=0.3)


def test_unknown_names_are_refused_before_anything_flies():
    with pytest.raises(ValueError, match=r"unknown world 'mujoko'.*Did you mean 'mujoco'"):
        fly(Pursuit(), [TrialSpec("zigzag", 0, 0)], VEHICLE, "mujoko")
    with pytest.raises(ValueError, match="zigzac"):
        fly(Pursuit(), [TrialSpec("zigzac", 0, 0)], VEHICLE)


@pytest.mark.parametrize("rate_hz", [0.0, -5.0, 501.0])
def test_a_policy_that_cannot_keep_time_is_refused(rate_hz):
    policy = Steady(spec=PolicySpec(rate_hz=rate_hz))
    with pytest.raises(ValueError, match="decides at"):
        fly(policy, [TrialSpec("zigzag", 0, 0)], VEHICLE)


def test_the_reference_world_records_nothing():
    with pytest.raises(ValueError, match="records no flights"):
        fly(Pursuit(), [TrialSpec("zigzag", 0, 0)], VEHICLE, "reference", record=Record())


def test_no_trials():
    assert fly(Pursuit(), [], VEHICLE) == []


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


@pytest.mark.parametrize("processes", [1, 2])
def test_interrupt_keeps_what_was_finished_and_the_rest_is_flown_later(tmp_path, processes):
    trials = [TrialSpec("zigzag", 3, seed) for seed in range(6)]
    options = JudgeOptions(slots=2, rules=SHORT, processes=processes)
    expected = fly(Pursuit(), trials, VEHICLE, options=JudgeOptions(rules=SHORT))
    path, about = tmp_path / "journal", {"policy": "pursuit"}
    with Journal(path, about) as journal, pytest.raises(KeyboardInterrupt):
        fly(Pursuit(), trials, VEHICLE, options=options, on_result=Interrupt(journal))
    assert multiprocessing.active_children() == []
    with Journal(path, about) as journal:
        left = journal.missing(trials)
        assert len(left) == 3
        fly(Pursuit(), left, VEHICLE, options=options, on_result=lambda r, _: journal.append(r))
        assert [journal.done[trial] for trial in trials] == expected


def test_a_policy_that_cannot_travel_is_refused_with_what_to_do():
    policy = Pursuit()
    setattr(policy, "unpicklable", lambda: None)  # noqa: B010
    with pytest.raises(ValueError, match="functools.partial"):
        fly(policy, [TrialSpec("zigzag", 0, 0)] * 2, VEHICLE, options=JudgeOptions(processes=2))

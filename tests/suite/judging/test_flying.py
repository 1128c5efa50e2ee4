"""Who flies which trials, in what manner, in how many processes, and its digest."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import eval.judging.judge
import suite
from eval.judging.results import read_trials
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from eval.worlds.trial import TrialSpec
from policies import shipped
from policies.policy import load_policy
from policies.spec import PolicyError, PolicySpec
from suite.cli import parse
from suite.judging import flying
from suite.judging.flying import Manner, manners, policy_labels, workers_for
from suite.judging.requests import Collection, Evaluation
from suite.judging.trials import read_trial_set, trial_list
from tests.support.commands import evaluate, refused
from tests.support.courses import IN_CONTACT
from tests.support.engines import STAND_IN
from tests.support.vehicles import with_effects
from tracks.common.work.pickling import pack
from tracks.formats.custom import load_track

YARD = str(Path(__file__).resolve().parents[3] / "tracks" / "examples" / "yard.toml")


@pytest.fixture(scope="module")
def policy():
    return load_policy("race-paper")


def test_policies_have_the_name_of_their_run_or_are_told_apart_and_none_flies_twice(tmp_path):
    names = ["a/last", "b/last", "c"]
    assert policy_labels(names, ["last", "last", "c"]) == names
    with pytest.raises(ValueError, match="given twice"):
        policy_labels(["a", "a"], ["a", "a"])
    shutil.copytree(shipped.folder("race-small"), tmp_path / "mine" / "policy")
    assert load_policy(tmp_path / "mine" / "policy").name == "mine"


def test_an_object_that_is_no_policy_or_whose_act_returns_something_else_is_refused_by_name():
    with pytest.raises(ValueError, match=r"has no name, start, act; a policy object has"):
        suite.evaluate_policy(SimpleNamespace(spec=None))  # type: ignore[arg-type]
    whole: Any = {"name": "mine", "spec": PolicySpec(), "start": lambda n: None, "act": None}
    for wrong, said in (
        ({}, "its act is None, not a method"),
        ({"name": None}, "its name is None, not a text"),
        ({"spec": {}}, r"its spec is \{\}, not a policies.spec.PolicySpec"),
        ({"start": 0}, "its start is 0, not a method"),
    ):
        members: Any = SimpleNamespace(**{**whole, **wrong})
        with pytest.raises(ValueError, match=said):
            suite.evaluate_policy(members)
        with pytest.raises(ValueError, match=said):
            eval.judging.judge.fly(members, [TrialSpec("zigzag", 0, 0)], load_vehicle("reference"))
    for returned, said in (
        (lambda n: np.zeros((n, 3)), "ndarray"),
        (lambda n: (np.zeros((n, 3)), None, None), "3 values"),
    ):
        act = lambda hidden, state, *rest, made=returned: made(len(state))  # noqa: E731
        members = SimpleNamespace(**{**whole, "act": act})
        for trials in (2, 3):
            with pytest.raises(ValueError, match=rf"act returned {said}.* tuple \(action, hidden"):
                suite.evaluate_policy(members, track="zigzag", difficulty=0, trials=trials)


def test_a_track_file_is_flown_once_a_seed_and_once_where_nothing_acts_by_chance(pilots, tmp_path):
    trials = trial_list([YARD, "zigzag"], [0, 9], trials=2, seed=3)
    assert [t[1:] for t in trials] == [(0, 3), (0, 4), (0, 3), (0, 4), (9, 3), (9, 4)]
    line = f"--track {YARD} --difficulty 4 --trials 1 --policy"
    assert evaluate(tmp_path, line, pilots["diver"]) == 0
    (row,) = read_trials(tmp_path / "trials.parquet")
    assert (row.track, row.difficulty, row.ended_by) == (YARD, 0, "collision")
    # Further seeds are the same flight, and would make the interval of a rate too narrow.
    asked = Evaluation(track=f"{YARD},zigzag", difficulty="0", trials=3)
    trials, notes = (getattr(read_trial_set(asked), name) for name in ("trials", "notes"))
    assert [trial.seed for trial in trials if trial.track == YARD] == [0] and len(trials) == 4
    assert len(notes) == 1 and "flown once, not 3 times" in notes[0]
    (note,) = read_trial_set(replace(asked, track=YARD, difficulty="0,5", trials=1)).notes
    assert "has no levels, so --difficulty does not change it" in note
    gusts = tmp_path / "gusts.toml"
    save_vehicle(with_effects(load_vehicle("reference"), gusts=(1.0, 5.0)), gusts, "for a test")
    for course in (
        read_trial_set(replace(asked, track=YARD, vehicle=str(gusts))),
        read_trial_set(replace(asked, track=YARD), repeated=True),
    ):
        assert [trial.seed for trial in course.trials] == [0, 1, 2] and not course.notes


@pytest.mark.parametrize(
    ("stage", "text", "flights", "noted"),
    [
        ("state", 'kind = "delay"\nstate = 0.03', 1, "flown once"),
        ("state", 'kind = "delay"\nstate = 0.03\njitter = 0.2', 3, None),
        ("state", 'kind = "drag_tilt"\ndrag = 0.3', 1, "flown once"),
        ("depth", 'kind = "image_motion"\nexposure = 0.01', 1, "flown once"),
        ("gates", 'kind = "gate_map"\nshift = 0.05', 3, None),
        ("imu", 'kind = "imu"\ngyro_noise = 0.1', 1, "the IMU has no effect"),
    ],
)
def test_sensors_without_random_numbers_give_equal_flights(tmp_path, stage, text, flights, noted):
    (tmp_path / "mine.toml").write_text(f'name = "mine"\n[[{stage}]]\n{text}\n')
    options = Evaluation(track=YARD, trials=3, sensors=str(tmp_path / "mine.toml"))
    trial_set = read_trial_set(options)
    assert len(trial_set.trials) == flights
    assert noted in trial_set.notes[-1] if noted else not trial_set.notes
    assert len(read_trial_set(replace(options, sensors="imu+gates")).trials) == 3


def test_a_start_in_contact_is_refused_wherever_a_track_file_is_flown(tmp_path, capsys):
    track = tmp_path / "low.toml"
    track.write_text(IN_CONTACT)
    for command in ("eval --policy race", "view race", "collect --policy race"):
        said = refused(capsys, command, "--track", track, "--out", tmp_path / "out")
        assert "low.toml: at start.position" in said and "touches ground" in said
    for given in (str(track), load_track(track)):
        with pytest.raises(ValueError, match="touches ground"):
            suite.evaluate_policy("race", track=given)


def test_from_python_a_track_file_is_flown_and_a_named_policy_in_several_processes(monkeypatch):
    flown = []

    def fly(policy, trials, vehicle, world, options, tracks):
        assert options.workers == 1 or pack(policy)
        flown.append((options.workers, trials, list(tracks)))

    monkeypatch.setattr(eval.judging.judge, "fly", fly)
    for track in (YARD, load_track(YARD)):
        with pytest.warns(UserWarning, match="flown once, not 10 times"):
            suite.evaluate_policy("race-paper", track=track, trials=10)
    # A policy object may be random.
    suite.evaluate_policy(load_policy("race-paper"), track=YARD, trials=10)
    suite.evaluate_policy(Path("race-paper"), track="zigzag", trials=2, workers=2)
    # Without a number, a program without a main guard must still run.
    suite.evaluate_policy("race-paper", track="zigzag", difficulty=3, trials=300)
    numbers = [(workers, len(trials)) for workers, trials, _ in flown]
    assert numbers == [(1, 1), (1, 1), (1, 10), (2, 4), (1, 300)]
    assert flown[0][1:] == ([TrialSpec(YARD, 0, 0)], [YARD])


def test_trials_and_slow_worlds_take_more_processes_and_seconds(monkeypatch):
    monkeypatch.setattr("suite.judging.flying.usable_cores", lambda: 4)
    assert [workers_for(n, None, "mujoco") for n in (1, 300, 3000)] == [1, 2, 4]
    assert workers_for(3000, None, "mjx") == 1
    assert [workers_for(10, asked, "mujoco") for asked in (3, "tcp://a:1")] == [3, "tcp://a:1"]
    slow, quick = (flying.flying_estimate(100, 1, name) for name in ("rotorpy", "mujoco"))
    assert slow.seconds > 3 * quick.seconds


def test_a_cluster_is_given_the_policy_and_this_machines_processes_its_name(policy):
    alone, here, there = (
        flying.policy_for_workers(policy, "race-paper", False, workers)
        for workers in (1, 2, "tcp://a:1")
    )
    assert alone is policy and len(pack(here)) < 1000 < 100_000 < len(pack(there))


def test_what_a_world_flies_otherwise_is_said_once_and_written(
    pilots, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("eval.worlds.rotorpy.rotorpy", lambda: STAND_IN)
    asked = "--simulator rotorpy --track zigzag --trials 2 --policy"
    assert evaluate(tmp_path, asked, pilots["diver"]) == 0
    note = "rotorpy: linear_drag: RotorPy's drag is proportional to the rotors' speed"
    assert capsys.readouterr().err.count(note) == 1
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert [text.split(":")[0] for text in summary["flown_otherwise"]] == [
        "linear_drag", "the rotors' drag acts at each hub and depends on the hub's airspeed",
    ]  # fmt: skip
    assert {row.world for row in read_trials(tmp_path / "trials.parquet")} == {"rotorpy"}


def test_every_speed_is_flown_and_again_with_the_monitor_where_a_policy_takes_one(
    policy, tmp_path, capsys
):
    assert manners((), False) == [Manner()]
    assert manners((0.0, 1.0), True) == [
        Manner(speed=0.0), Manner(speed=1.0), Manner(True, 0.0), Manner(True, 1.0)
    ]  # fmt: skip
    assert Manner(True, 0.25).label("mine") == "mine@0.25+monitor"
    assert Manner().label("mine") == "mine"
    quick = replace(policy, spec=replace(policy.spec, speed_input=True))
    assert Manner(speed=0.0)(quick).spec.speed == 0.0
    assert Manner()(quick) is quick
    with pytest.raises(PolicyError, match="race-paper takes no speed"):
        Manner(speed=0.5)(policy)
    said = refused(capsys, "eval --policy race-paper --speed 0.5 --out", tmp_path)
    assert "spec.speed_input=True" in said


def test_options_become_the_request_and_recorded_seeds_are_far_from_judged_ones():
    def asked(command: str, *args: str) -> Any:
        config = parse(command, args)[1]
        held = (config, *vars(config).values())
        return next(value for value in held if isinstance(value, Evaluation | Collection))

    given = asked("eval", "--policy", "race-paper", "--policy", "a.onnx", "--trials", "2")
    assert (given.policies, given.trials) == (("race-paper", "a.onnx"), 2)
    assert asked("collect").seed - asked("eval").seed >= 100_000

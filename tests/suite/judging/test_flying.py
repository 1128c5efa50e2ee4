"""Who flies which trials, in what manner, in how many processes, and its digest."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import suite
from eval.judging.results import read_trials
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from policies import shipped
from policies.policy import load_policy
from policies.spec import PolicyError
from suite import cli
from suite.cli import parse
from suite.judging.flying import (
    Manner,
    flying_estimate,
    load_in_manner,
    manners,
    policy_for_workers,
    policy_labels,
    workers_for,
)
from suite.judging.requests import Collection, Evaluation
from suite.judging.trials import read_trial_set, trial_list
from tests.support.engines import STAND_IN
from tests.support.vehicles import with_effects
from tracks.common.work.pickling import pack

ROOT = Path(__file__).resolve().parents[3]


def _eval(out, *args):
    args = args if "--difficulty" in args else (*args, "--difficulty", "0")
    return cli.main(["eval", "--out", str(out), *args])


def test_policies_of_one_name_are_told_apart_and_none_flies_twice():
    assert policy_labels(["a/last", "b/last", "c"], ["last", "last", "c"]) == [
        "a/last",
        "b/last",
        "c",
    ]
    with pytest.raises(ValueError, match="given twice"):
        policy_labels(["a", "a"], ["a", "a"])


def test_a_trained_policy_has_the_name_of_its_run(tmp_path):
    shutil.copytree(shipped.folder("race-small"), tmp_path / "mine" / "policy")
    assert load_policy(tmp_path / "mine" / "policy").name == "mine"


def test_a_policy_object_that_lacks_a_method_is_refused_by_name():
    with pytest.raises(ValueError, match=r"has no name, start, act; a policy object has"):
        suite.evaluate_policy(SimpleNamespace(spec=None))  # type: ignore[arg-type]


def test_a_track_file_is_flown_once_a_seed(pilots, tmp_path):
    track = str(ROOT / "tracks" / "examples" / "yard.toml")
    trials = trial_list([track, "zigzag"], [0, 9], trials=2, seed=3)
    assert [t[1:] for t in trials] == [(0, 3), (0, 4), (0, 3), (0, 4), (9, 3), (9, 4)]
    args = ["--track", track, "--difficulty", "4", "--trials", "1", "--policy", pilots["diver"]]
    assert _eval(tmp_path / "out", *args) == 0
    (row,) = read_trials(tmp_path / "out" / "trials.parquet")
    assert (row.track, row.difficulty, row.ended_by) == (track, 0, "collision")


def test_where_nothing_acts_by_chance_a_track_file_is_flown_once(tmp_path):
    """Further seeds are the same flight, and would make the interval of a rate too narrow."""
    track = str(ROOT / "tracks" / "examples" / "yard.toml")
    course = read_trial_set(Evaluation(track=f"{track},zigzag", difficulty="0", trials=3))
    assert [t.seed for t in course.trials if t.track == track] == [0]
    assert len(course.trials) == 4
    (note,) = course.notes
    assert "flown once, not 3 times" in note
    gusts = tmp_path / "gusts.toml"
    save_vehicle(with_effects(load_vehicle("reference"), gusts=(1.0, 5.0)), gusts, "for a test")
    course = read_trial_set(Evaluation(track=track, difficulty="0", trials=3, vehicle=str(gusts)))
    assert len(course.trials) == 3 and not course.notes


def test_trials_and_slow_worlds_take_more_processes_and_seconds(monkeypatch):
    monkeypatch.setattr("suite.judging.flying.usable_cores", lambda: 4)
    assert [workers_for(n, None, "mujoco") for n in (1, 300, 3000)] == [1, 2, 4]
    assert workers_for(3000, None, "mjx") == 1
    assert [workers_for(10, asked, "mujoco") for asked in (3, "tcp://a:1")] == [3, "tcp://a:1"]
    assert flying_estimate(100, 1, "rotorpy").seconds > 3 * flying_estimate(100, 1).seconds


def test_a_cluster_is_given_the_policy_and_this_machines_processes_its_name():
    policy = load_in_manner("race-paper", False)
    assert policy_for_workers(policy, "race-paper", False, 1) is policy
    here, there = (
        policy_for_workers(policy, "race-paper", False, 2),
        policy_for_workers(policy, "race-paper", False, "tcp://a:1"),
    )
    assert len(pack(here)) < 1000 < 100_000 < len(pack(there))


def test_what_a_world_flies_otherwise_is_said_once_and_written(
    pilots, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr("eval.worlds.rotorpy.rotorpy", lambda: STAND_IN)
    args = [
        "--simulator",
        "rotorpy",
        "--track",
        "zigzag",
        "--trials",
        "2",
        "--policy",
        pilots["diver"],
    ]
    assert _eval(tmp_path / "out", *args) == 0
    said = capsys.readouterr().err
    assert (
        said.count("rotorpy: linear_drag: RotorPy's drag is proportional to the rotors' speed") == 1
    )
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [text.split(":")[0] for text in summary["flown_otherwise"]] == [
        "linear_drag", "the rotors' drag acts at each hub and depends on the hub's airspeed",
    ]  # fmt: skip
    assert {row.world for row in read_trials(tmp_path / "out" / "trials.parquet")} == {"rotorpy"}


@pytest.fixture(scope="module")
def policy():
    return load_policy("race-paper")


def test_every_speed_is_flown_and_again_with_the_monitor():
    assert manners((), False) == [Manner()]
    assert manners((0.0, 1.0), True) == [
        Manner(speed=0.0), Manner(speed=1.0), Manner(True, 0.0), Manner(True, 1.0)
    ]  # fmt: skip
    assert Manner(True, 0.25).label("mine") == "mine@0.25+monitor"
    assert Manner().label("mine") == "mine"


def test_a_speed_goes_into_the_spec_that_is_observed_by(policy):
    quick = replace(policy, spec=replace(policy.spec, speed_input=True))
    assert Manner(speed=0.0)(quick).spec.speed == 0.0
    assert Manner()(quick) is quick


def test_a_policy_without_that_input_is_one_line(policy, tmp_path, capsys):
    with pytest.raises(PolicyError, match="race-paper takes no speed"):
        Manner(speed=0.5)(policy)
    assert (
        cli.main(["eval", "--policy", "race-paper", "--speed", "0.5", "--out", str(tmp_path)]) == 2
    )
    said = capsys.readouterr().err
    assert "spec.speed_input=True" in said and len(said.strip().splitlines()) == 1


def asked(command: str, *args: str) -> Any:
    config = parse(command, args)[1]
    held = (config, *vars(config).values())
    return next(value for value in held if isinstance(value, Evaluation | Collection))


def test_options_become_the_request_and_recorded_seeds_are_far_from_judged_ones():
    given = asked("eval", "--policy", "race-paper", "--policy", "a.onnx", "--trials", "2")
    assert (given.policies, given.trials) == (("race-paper", "a.onnx"), 2)
    assert asked("collect").seed - asked("eval").seed >= 100_000

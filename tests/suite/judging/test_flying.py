"""Who flies which trials, and how; a policy as content; the Python interface; users' own files."""

import json
import shutil
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest
import torch

import eval.judging.judge
import suite
from eval.effects import EFFECTS
from eval.judging.results import read_trials
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from eval.worlds import WORLDS
from eval.worlds.mujoco import MujocoWorld
from eval.worlds.trial import TrialSpec
from policies import shipped
from policies.contract import contract_of
from policies.formats.c.project import random_observations
from policies.formats.export import export_module
from policies.policy import load_policy
from policies.spec import PolicyError, PolicySpec
from suite.cli import parse
from suite.commands import check
from suite.common.console import Quiet
from suite.diagnose.example import flights as example
from suite.judging import checking, flying
from suite.judging.content import PolicyContent, policy_digest
from suite.judging.flying import Manner, manners, policy_labels, workers_for
from suite.judging.requests import Collection, Evaluation
from suite.judging.trials import read_trial_set, trial_list
from tests.support.commands import evaluate, refused
from tests.support.courses import IN_CONTACT, ONE_GATE
from tests.support.engines import STAND_IN
from tests.support.pilots import Pursuit
from tests.support.tools import python
from tests.support.vehicles import with_effects
from tracks.common.work.pickling import pack, unpack
from tracks.families import FAMILIES
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
    shutil.copytree(shipped.locate("race-small"), tmp_path / "mine" / "policy")
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


def test_an_object_whose_rows_depend_on_each_other_is_refused_and_memory_warns(monkeypatch):
    monkeypatch.setattr(eval.judging.judge, "fly", lambda *_, **__: [])

    @dataclass
    class Own(Pursuit):
        kind: str = ""
        calls: int = 0

        def act(self, hidden, state, image, fresh):
            action, hidden = super().act(hidden, state, image, fresh)
            self.calls += 1
            return {
                "mean": action - state.mean(0)[:3],
                "image": action - image.mean(),
                "count": action / len(state),
                "memory": action + np.float32(self.calls),
                "fixed": action if len(state) == 7 else action[:0],
            }.get(self.kind, action), hidden

    for kind in ("mean", "image", "count"):
        with pytest.raises(ValueError, match="a row's action changes by .* other rows"):
            suite.evaluate_policy(Own(kind=kind), trials=1)
    policy = Own(kind="memory")
    with pytest.warns(UserWarning, match="the same inputs gave two answers"):
        suite.evaluate_policy(policy, trials=1)
    assert policy.calls == 0
    for kind in ("", "fixed"):  # the judge reports what an object cannot answer
        suite.evaluate_policy(Own(kind=kind), trials=1)


def test_a_track_file_is_flown_once_a_seed_and_once_where_nothing_acts_by_chance(pilots, tmp_path):
    trials = trial_list([YARD, "zigzag"], [0, 9], trials=2, seed=3)
    assert [t[1:] for t in trials] == [(0, 3), (0, 4), (0, 3), (0, 4), (9, 3), (9, 4)]
    line = f"--track {YARD} --difficulty 4 --trials 1 --time-limit-s 2 --policy"
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
        ("gates", 'kind = "gate_map"\nshift = 0.05', 3, None),
        ("imu", 'kind = "imu"\ngyro_noise = 0.1', 1, "the IMU has no effect"),
        ("depth", 'kind = "tof"', 3, "tof has no effect, because the sizes of all its errors"),
        ("state", 'kind = "state_loss"\nlength = 1.0', 3, "give one, such as 'share'"),
    ],
)
def test_sensors_without_random_numbers_give_equal_flights(tmp_path, stage, text, flights, noted):
    (tmp_path / "mine.toml").write_text(f'name = "mine"\n[[{stage}]]\n{text}\n')
    (track := tmp_path / "course.toml").write_text(ONE_GATE)
    options = Evaluation(track=str(track), trials=3, sensors=str(tmp_path / "mine.toml"))
    trial_set = read_trial_set(options)
    assert len(trial_set.trials) == flights
    assert noted in trial_set.notes[-1] if noted else not trial_set.notes
    assert len(read_trial_set(replace(options, sensors="imu+gates")).trials) == 3
    (tmp_path / "mine.toml").write_text('name = "mine"\n')
    assert "no sensor model is in the file" in read_trial_set(options).notes[-1]


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

    def fly(policy, trials, vehicle, world, options, on_result, record, tracks):
        assert options.workers == 1 or pack(policy)
        return flown.append((options.workers, trials, list(tracks))) or []

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


def test_other_processes_are_given_the_content_of_the_policy(policy):
    content = PolicyContent.of("race-paper")
    alone, here, there = (
        flying.policy_for_workers(policy, content, workers) for workers in (1, 2, "tcp://a:1")
    )
    assert alone is policy and pack(here) == pack(there) and len(pack(here)) > 100_000


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
    assert summary["over_plan"] == []  # the plans are laps of the vehicle in the file
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


def answers(policy):
    state, image, _ = random_observations(policy.spec, 64)
    return policy.act(policy.start(64), state, image, np.ones(64, bool))[0]


@pytest.mark.parametrize(("at", "name"), [("my.policy", "my.policy"), ("mine/policy", "mine")])
def test_a_policy_as_content_keeps_its_name_and_is_the_same_without_its_files(at, name, tmp_path):
    (folder := tmp_path / at).mkdir(parents=True)
    for file in ("config.json", "weights.safetensors", "card.md"):
        (folder / file).write_bytes((shipped.locate("race-paper") / file).read_bytes())
    content = PolicyContent.of(folder)
    assert [name for name, _ in content.files] == ["config.json", "weights.safetensors"]
    packed, expected = pack(content), answers(load_policy(folder))
    shutil.rmtree(folder)
    found = unpack(packed)()
    assert found.name == name and unpack(packed)() is found, "loaded once"
    assert np.array_equal(answers(found), expected)
    (tmp_path / "policy.h").write_text("a header")
    (tmp_path / "policy.c").write_text("a program")
    content = PolicyContent.of(tmp_path / "policy.c")
    assert content.name == f"{tmp_path.parent.name}/{tmp_path.name}" and content.file == "policy.c"
    assert [name for name, _ in content.files] == ["policy.h", "policy.c"]
    with pytest.raises(PolicyError, match="trust"):
        content()


def test_a_digest_changes_with_any_byte_of_what_flies_and_no_other(tmp_path):
    folder, seen = tmp_path / "p", []
    folder.mkdir()
    for name, text in (("config.json", "{}"), ("config.json", "{ }"), ("weights.safetensors", "a")):
        (folder / name).write_text(text)
        seen.append(policy_digest(str(folder)))
    assert len(set(seen)) == 3
    (folder / "card.md").write_text("words")
    assert policy_digest(str(folder)) == seen[-1]
    path, seen = onnx_file(tmp_path), []
    for scale in (1, 2):
        (tmp_path / "w.bin").write_bytes(np.full(300, scale, np.float32).tobytes())
        seen.append(policy_digest(str(path)))
    assert len(set(seen)) == 2


def test_an_onnx_file_behind_a_link_comes_with_its_weights(tmp_path):
    folder = tmp_path / "real"
    folder.mkdir()
    path = onnx_file(folder)
    (tmp_path / "there").symlink_to(folder)
    (tmp_path / "mine.onnx").symlink_to(path)
    whole = {name: (folder / name).read_bytes() for name in ("it.onnx", "w.bin")}
    content = PolicyContent.of(tmp_path / "there" / "it.onnx")
    assert (content.name, content.file) == (f"{tmp_path.name}/real", "it.onnx")
    assert dict(content.files) == whole
    content = PolicyContent.of(tmp_path / "mine.onnx")
    assert content.file == "mine.onnx"
    assert dict(content.files) == {"mine.onnx": whole["it.onnx"], "w.bin": whole["w.bin"]}


def onnx_file(folder):
    """Write it.onnx with its weights beside it in w.bin; return its path."""
    onnx = pytest.importorskip("onnx")
    weights = onnx.numpy_helper.from_array(np.ones(300, np.float32), "w")
    node = onnx.helper.make_node("Identity", ["w"], ["action"])
    graph = onnx.helper.make_graph([node], "g", [], [], [weights])
    path = folder / "it.onnx"
    onnx.save(
        onnx.helper.make_model(graph), path,
        save_as_external_data=True, location="w.bin", size_threshold=0,
    )  # fmt: skip
    return path


FLIGHT = min(path.name for path in example.FOLDER.glob("*.parquet"))


def test_a_track_with_gates_far_apart_is_reported(tmp_path):
    far = tmp_path / "far.toml"
    far.write_text("[[gates]]\ncenter = [0, 0, 1300]\nwidth = 1\nheight = 1\n")
    far.write_text(far.read_text() + far.read_text().replace("[0,", "[5000,"))
    assert "5000 m apart" in read_trial_set(Evaluation(track=str(far), trials=1)).notes[0]


def test_modules_in_the_working_folder_do_not_stand_for_ours_or_pythons(tmp_path, root):
    for name in ("eval", "socket", "tokenize"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('mine')\n")
    code = (
        f"import sys; sys.path[0] = {str(root)!r}; import socket, tokenize\n"
        "from suite import cli\n"
        "from tracks.common.work.processes import worker_pool\n"
        "sys.path.insert(0, ''); sys.argv[1:] = ['effects']; main = cli.main\n"
        # A process of its own begins as those that fly trials do.
        "cli.main = lambda: main() or worker_pool(1).submit(int, 0).result()\n"
        "cli.entry()\n"
    )
    done = python(code, cwd=tmp_path)
    assert done.returncode == 0 and "mine" not in done.stderr, done.stderr


def test_files_come_back_and_a_program_registers_names_for_its_process(tmp_path, monkeypatch):
    vehicle, log = suite.load_vehicle("racer5"), suite.read_flight(example.FOLDER / FLIGHT)
    suite.save_vehicle(vehicle, tmp_path / "it.toml")
    assert suite.load_vehicle(tmp_path / "it.toml") == vehicle
    again = suite.read_flight(suite.write_flight(tmp_path / "it.parquet", log))
    np.testing.assert_array_equal(again.pos_w, log.pos_w)
    effect = replace(EFFECTS["linear_drag"], name="mine")
    for registry, value, register in (
        (EFFECTS, effect, suite.register_effect),
        (FAMILIES, lambda difficulty, rng: None, partial(suite.register_track, "mine")),
        (WORLDS, type("Mine", (MujocoWorld,), {}), partial(suite.register_simulator, "mine")),
    ):
        for held in ("_entries", "_values"):
            monkeypatch.setattr(registry, held, dict(getattr(registry, held)))
        register(value)
        assert registry["mine"] is value
        with pytest.raises(ValueError, match="'mine' exists already"):
            register(value)


def test_check_reports_the_contract_and_an_unscaled_file_that_says_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(checking, "TIME_LIMIT_S", 1.5)
    answer = check.run(check.Config(policy="race-small", trials=1), Quiet())
    assert answer["findings"] == [] and answer["contract"]["digest"]
    with pytest.raises(ValueError, match="nothing to check"):
        check.run(check.Config(), Quiet())

    class Unscaled(torch.nn.Module):
        def forward(self, state, image):
            return torch.tanh(state[:, 6:9]) + 0 * image.mean((1, 2))[:, None]

    path = export_module(Unscaled(), tmp_path / "it.onnx", PolicySpec())
    proto = onnx.load(path)
    del proto.metadata_props[:]
    onnx.save(proto, path)
    answer = check.run(check.Config(policy=str(path), trials=1), Quiet())
    faults = [finding["fault"] for finding in answer["findings"]]
    assert faults[0] == "no_contract" and "action_scale" in faults
    assert "30 Hz" in answer["findings"][0]["evidence"]
    assert "78.4 x 63.8 deg, range 10 m" in answer["findings"][0]["evidence"]
    assert answer["contract"]["digest"] == contract_of(PolicySpec(), ()).digest

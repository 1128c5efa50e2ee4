"""suite eval, collect and view, flown by pilots that need no training."""

import json
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import eval.judging.judge
import eval.logs.flight_log
import policies.policy
from eval.judging.results import read_trials
from eval.logs.flight_log import read_flight
from suite import cli
from suite.judging.flying import labels, options_for, policy_digest, trial_list
from tests.support.pilots import Pursuit, Steady

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def pilots(monkeypatch, tmp_path):
    """Make the policy files `pursuit` and `diver`; the other ways to load stay."""
    made = {
        "pursuit": Pursuit(),
        "diver": Steady((0.0, 0.0, -8.0), name="diver"),
        "diver2": Steady((1.0, 0.0, -8.0), name="diver"),
    }
    files = {name: tmp_path / name for name in made}
    for name, file in files.items():
        file.write_text(name)
    load = policies.policy.load_policy

    def load_pilot(name, trust=False):
        known = {str(file): made[pilot] for pilot, file in files.items()}
        return known.get(str(name)) or load(name, trust)

    monkeypatch.setattr(policies.policy, "load_policy", load_pilot)
    return {name: str(file) for name, file in files.items()}


def _eval(out, *args):
    return cli.main(["eval", "--out", str(out), *args])


def test_eval_writes_the_tables_and_says_them(pilots, tmp_path, capfd):
    out = tmp_path / "out"
    args = ["--track", "zigzag", "--trials", "2", "--seed", "5", "--json"]
    code = _eval(out, *args, "--policy", pilots["pursuit"], "--policy", pilots["diver"])
    said = json.loads(capfd.readouterr().out)
    assert code == 0
    names = {path.name for path in out.iterdir()}
    assert names == {"trials.parquet", "table.md", "summary.json", "run.json"}
    rows = read_trials(out / "trials.parquet")
    keys = [(row.track, row.difficulty, row.seed, row.policy) for row in rows]
    assert keys == [("zigzag", 0, s, p) for p in ("pursuit", "diver") for s in (5, 6)]
    assert rows[0].gates_passed > 0 and rows[2].ended_by == "collision"
    summary = json.loads((out / "summary.json").read_text())
    assert {key: said[key] for key in summary} == summary
    assert [cell["policy"] for cell in summary["cells"]] == ["pursuit", "diver"]
    assert summary["paired"][0]["trials"] == 2
    header = json.loads(pq.read_schema(out / "trials.parquet").metadata[b"suite"])
    assert set(header) >= {"schema", "suite_version", "git_commit", "seed"}


def test_an_interrupted_eval_goes_on_to_the_same_result(pilots, tmp_path, monkeypatch, capfd):
    args = ["--track", "circular,zigzag", "--trials", "2", "--policy", pilots["pursuit"]]
    assert _eval(tmp_path / "whole", *args) == 0
    fly = eval.judging.judge.fly
    flown = []

    def fly_until_interrupted(policy, trials, vehicle, world, options, on_result, **rest):
        def keep(result, flight):
            on_result(result, flight)
            flown.append(result.trial)
            if len(flown) == 1:
                raise KeyboardInterrupt

        return fly(policy, trials, vehicle, world, options, keep, **rest)

    monkeypatch.setattr(eval.judging.judge, "fly", fly_until_interrupted)
    assert _eval(tmp_path / "again", *args) == 130
    assert not (tmp_path / "again" / "trials.parquet").exists()
    assert _eval(tmp_path / "again", *args) == 0
    assert len(flown) == len(set(flown)) == 4, "no trial is flown twice"
    assert "1 trials were flown before" in capfd.readouterr().err
    whole, again = (read_trials(tmp_path / name / "trials.parquet") for name in ("whole", "again"))
    assert again == whole


def test_a_journal_of_something_else_is_not_mixed_in(pilots, tmp_path, monkeypatch, capsys):
    def interrupted(*args, **rest):
        raise KeyboardInterrupt

    args = ["--track", "zigzag", "--trials", "1"]
    with monkeypatch.context() as patch:
        patch.setattr(eval.judging.judge, "fly", interrupted)
        assert _eval(tmp_path / "out", *args, "--policy", pilots["pursuit"]) == 130
    assert _eval(tmp_path / "out", *args, "--policy", pilots["diver"]) == 2
    assert "another --out" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--trials", "0"], "--trials is 0; it must be 1 or more"),
        (["--seed", "-1"], "--seed is -1"),
        (["--difficulty", "10"], "level 10 is not 0 to 9"),
        (["--track", "zigzg"], "Did you mean 'zigzag'?"),
        (["--track", "no_such.toml"], "no_such.toml"),
        (["--world", "mujco"], "Did you mean 'mujoco'?"),
        (["--vehicle", "referense"], "Did you mean 'reference'?"),
        (["--policy", "nobody_we_know"], "nobody_we_know"),
        (["--rerun", "trials.mp4"], "must end in .rrd"),
    ],
)
def test_what_cannot_be_used_is_said_before_the_first_flight(
    args, words, pilots, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(eval.judging.judge, "fly", None)
    given = [] if "--policy" in args else ["--policy", pilots["diver"]]
    assert _eval(tmp_path / "out", *args, *given) == 2
    said = capsys.readouterr().err
    assert words in said and "Traceback" not in said
    assert len(said.strip().splitlines()) == 1


def test_policies_of_one_name_are_told_apart_and_none_flies_twice():
    assert labels(["a/last", "b/last", "c"], ["last", "last", "c"]) == ["a/last", "b/last", "c"]
    with pytest.raises(ValueError, match="given twice"):
        labels(["a", "a"], ["a", "a"])


def test_a_track_file_is_flown_once_a_seed(pilots, tmp_path):
    track = str(ROOT / "tracks" / "examples" / "yard.toml")
    trials = trial_list([track, "zigzag"], [0, 9], trials=2, seed=3)
    assert [t[1:] for t in trials] == [(0, 3), (0, 4), (0, 3), (0, 4), (9, 3), (9, 4)]
    args = ["--track", track, "--difficulty", "4", "--trials", "1", "--policy", pilots["diver"]]
    assert _eval(tmp_path / "out", *args) == 0
    (row,) = read_trials(tmp_path / "out" / "trials.parquet")
    assert (row.track, row.difficulty, row.ended_by) == (track, 0, "collision")


def test_more_trials_take_more_processes_up_to_what_there_is(monkeypatch):
    monkeypatch.setattr("suite.judging.flying.usable_cores", lambda: 4)
    assert [options_for(n, None, "mujoco").processes for n in (1, 300, 3000)] == [1, 2, 4]
    assert options_for(3000, None, "mjx").processes == 1
    assert options_for(10, 3, "mujoco").processes == 3


def test_a_digest_changes_with_any_byte_of_what_flies_and_no_other(tmp_path):
    folder, seen = tmp_path / "p", []
    folder.mkdir()
    for name, text in (("config.json", "{}"), ("config.json", "{ }"), ("weights.safetensors", "a")):
        (folder / name).write_text(text)
        seen.append(policy_digest(str(folder)))
    assert len(set(seen)) == 3
    (folder / "card.md").write_text("words")
    assert policy_digest(str(folder)) == seen[-1]


def test_a_digest_changes_with_weights_beside_an_onnx_file(tmp_path):
    onnx = pytest.importorskip("onnx")
    weights = onnx.numpy_helper.from_array(np.ones(300, np.float32), "w")
    node = onnx.helper.make_node("Identity", ["w"], ["action"])
    graph = onnx.helper.make_graph([node], "g", [], [], [weights])
    path, seen = tmp_path / "it.onnx", []
    onnx.save(
        onnx.helper.make_model(graph), path,
        save_as_external_data=True, location="w.bin", size_threshold=0,
    )  # fmt: skip
    for scale in (1, 2):
        (tmp_path / "w.bin").write_bytes(np.full(300, scale, np.float32).tobytes())
        seen.append(policy_digest(str(path)))
    assert len(set(seen)) == 2


def test_view_flies_the_chosen_trials_again(pilots, tmp_path, capfd):
    out, seen = tmp_path / "out", tmp_path / "seen"
    policy = ["--policy", pilots["diver"]]
    assert _eval(out, "--track", "ellipse", "--trials", "3", "--seed", "2", *policy) == 0
    capfd.readouterr()
    view = ["view", str(out), "--out", str(seen)]
    assert cli.main([*view, "--pick", "failed", "--count", "2", "--gif", "--json"]) == 0
    said = json.loads(capfd.readouterr().out)
    names = sorted(path.name for path in seen.iterdir())
    assert names == ["ellipse-0-2.gif", "ellipse-0-2.png", "ellipse-0-3.png", "trials.rrd"]
    rows = read_trials(out / "trials.parquet")
    assert said["trials"][0]["time_s"] == rows[0].time_s
    assert cli.main([*view, "--pick", "passed"]) == 2
    assert "--pick passed" in capfd.readouterr().err


def test_view_of_something_else_is_refused(tmp_path, capsys):
    (tmp_path / "trials.parquet").write_text("no parquet")
    assert cli.main(["view", str(tmp_path)]) == 2
    assert "run.json" in capsys.readouterr().err


def test_collect_writes_logs_that_read_back_and_goes_on(pilots, tmp_path, monkeypatch, capfd):
    out = tmp_path / "flights"
    args = ["collect", "--policy", pilots["pursuit"], "--track", "zigzag", "--difficulty", "0"]
    args += ["--trials", "2", "--seed", "7", "--out", str(out)]
    assert cli.main(args) == 0
    logs = sorted(out.glob("*.parquet"))
    assert [log.name for log in logs] == ["zigzag-0-7.parquet", "zigzag-0-8.parquet"]
    log = read_flight(logs[0])
    assert log.about["seed"] == 7 and log.time_s[-1] >= 1
    found = json.loads((out / "flights.json").read_text())
    assert [row["file"] for row in found["flights"]] == [log.name for log in logs]
    logs[1].unlink()
    flown = []
    fly = eval.judging.judge.fly

    def count(policy, trials, *rest, **more):
        flown.extend(trials)
        return fly(policy, trials, *rest, **more)

    monkeypatch.setattr(eval.judging.judge, "fly", count)
    capfd.readouterr()
    assert cli.main([*args, "--json"]) == 0
    assert [trial.seed for trial in flown] == [8]
    assert json.loads(capfd.readouterr().out)["flights"] == found["flights"]


def test_a_flight_of_under_a_second_is_no_log(pilots, tmp_path, capfd):
    out = tmp_path / "flights"
    args = ["collect", "--policy", pilots["diver"], "--track", "zigzag", "--difficulty", "0"]
    assert cli.main([*args, "--trials", "1", "--out", str(out)]) == 0
    (row,) = json.loads((out / "flights.json").read_text())["flights"]
    assert row["file"] is None and row["time_s"] < 1
    assert not list(out.glob("*.parquet"))


def test_a_flight_whose_log_is_refused_does_not_stop_the_others(
    pilots, tmp_path, monkeypatch, capfd
):
    log_from_flight = eval.logs.flight_log.log_from_flight

    def broken(flight, name):
        log = log_from_flight(flight, name)
        if name.endswith("-7.parquet"):
            log.rate_b[4, 0] = 300.0
        return log

    monkeypatch.setattr(eval.logs.flight_log, "log_from_flight", broken)
    out = tmp_path / "flights"
    args = ["collect", "--policy", pilots["pursuit"], "--track", "zigzag", "--difficulty", "0"]
    assert cli.main([*args, "--trials", "2", "--seed", "7", "--out", str(out)]) == 0
    flights = json.loads((out / "flights.json").read_text())["flights"]
    assert [row["file"] for row in flights] == [None, "zigzag-0-8.parquet"]
    said = capfd.readouterr()
    assert "zigzag-0-7.parquet: column rate_x, row 5: 300" in said.err
    assert "1 without a log, 0 of them under 1 s" in said.out


def test_export_refuses_what_is_not_ours(tmp_path, capsys):
    assert cli.main(["export", "nobody", "--out", str(tmp_path)]) == 2
    assert "nobody" in capsys.readouterr().err

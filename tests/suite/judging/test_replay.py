"""suite view flies judged trials again."""

import json
import shutil
from pathlib import Path

import pytest

import eval.judging.judge
from eval.judging.results import read_trials
from suite import cli
from suite.commands import view
from suite.common.console import Quiet
from suite.judging.evaluate import evaluate
from suite.judging.flying import Manner, manners
from suite.judging.replay import read_evaluation
from suite.judging.requests import Evaluation
from tests.support.recordings import columns


def _eval(out, *args):
    args = args if "--difficulty" in args else (*args, "--difficulty", "0")
    return cli.main(["eval", "--out", str(out), *args])


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


@pytest.mark.parametrize(
    ("what", "was", "now"),
    [
        ("policy", "diver", "another"),
        ("vehicle", "mass = 0.75", "mass = 0.85"),
        ("track", "width = 1.1", "width = 1.2"),
    ],
)
def test_a_run_whose_files_have_changed_is_not_flown_again(
    what, was, now, pilots, tmp_path, root, monkeypatch, capsys
):
    """It would show flights that nobody judged."""
    files = {"policy": Path(pilots["diver"])}
    files["vehicle"] = Path(shutil.copy(root / "eval/vehicles/racer5.toml", tmp_path))
    files["track"] = shutil.copytree(root / "tracks/examples", tmp_path / "tracks") / "yard.toml"
    flown = [text for name, file in files.items() for text in (f"--{name}", str(file))]
    out = tmp_path / "out"
    assert _eval(out, *flown, "--trials", "1", "--time-limit-s", "0.5") == 0
    view, old = ["view", str(out), "--out", str(tmp_path / "seen")], files[what].read_text()
    assert was in old
    if what != "policy":
        files[what].write_text(f"# a comment\n{old}")
    assert cli.main(view) == 0
    files[what].write_text(old.replace(was, now, 1))
    capsys.readouterr()
    monkeypatch.setattr(eval.judging.judge, "fly", None)
    assert cli.main(view) == 2
    said = capsys.readouterr().err
    assert f"{what} {files[what]}: has changed since these trials were judged" in said
    assert "restore the judged version" in said


def test_a_run_of_an_earlier_version_is_held_to_its_policy(pilots, tmp_path, capsys):
    out, path = tmp_path / "out", tmp_path / "out" / "summary.json"
    flown = ["--policy", pilots["diver"], "--track", "zigzag", "--trials", "1"]
    assert _eval(out, *flown) == 0
    summary = json.loads(path.read_text())
    del summary["sha256"]
    path.write_text(json.dumps(summary))
    view = ["view", str(out), "--out", str(tmp_path / "seen")]
    assert cli.main(view) == 0
    path.write_text(json.dumps({**summary, "policies": []}))
    assert cli.main(view) == 2
    assert "does not say which policy was judged" in capsys.readouterr().err
    path.write_text(json.dumps({**summary, "policies": [{"sha256": "another"}]}))
    assert cli.main(view) == 2
    assert f"policy {pilots['diver']}: has changed" in capsys.readouterr().err


def test_a_run_from_python_with_a_whole_number_of_seconds_is_seen_again(pilots, tmp_path):
    asked = Evaluation(policies=(pilots["diver"],), track="zigzag", trials=1, time_limit_s=1)
    evaluate(asked, tmp_path / "out", Quiet())
    assert read_evaluation(tmp_path / "out") == asked
    assert cli.main(["view", str(tmp_path / "out"), "--out", str(tmp_path / "seen")]) == 0


def test_a_run_does_not_say_itself_that_it_is_to_be_trusted(tmp_path, capsys):
    """What `suite view` is given may come from anywhere, and name a program."""
    out, program = tmp_path / "out", tmp_path / "policy.c"
    assert _eval(out, "--track", "zigzag", "--trials", "1", "--time-limit-s", "0.1") == 0
    program.write_text("this is no C, and nobody is to compile it")
    record = json.loads((out / "run.json").read_text())
    record["config"] |= {"policies": [str(program)], "trust": True}
    (out / "run.json").write_text(json.dumps(record))
    capsys.readouterr()
    assert cli.main(["view", str(out), "--out", str(tmp_path / "seen")]) == 2
    assert "if you trust its author, pass --trust" in capsys.readouterr().err
    assert cli.main(["view", str(out), "--out", str(tmp_path / "seen"), "--trust"]) == 2
    assert "pass --trust" not in capsys.readouterr().err


def test_a_trial_ends_at_the_time_that_is_given_and_is_seen_so_again(pilots, tmp_path, capfd):
    out, limit = tmp_path / "out", ["--time-limit-s", "1.2"]
    flown = ["--track", "zigzag", "--trials", "1", "--policy", pilots["pursuit"], *limit]
    assert _eval(out, *flown) == 0
    (row,) = read_trials(out / "trials.parquet")
    assert (row.ended_by, row.time_s) == ("timeout", 1.2)
    assert cli.main(["view", str(out), "--out", str(tmp_path / "seen")]) == 0
    assert "timeout after 1.2 s" in capfd.readouterr().out
    assert cli.main(["collect", "--out", str(tmp_path / "logs"), "--difficulty", "0", *flown]) == 0
    listed = json.loads((tmp_path / "logs" / "flights.json").read_text())
    assert [flight["time_s"] for flight in listed["flights"]] == [1.2]
    assert _eval(out, *flown[:-1], "0") == 2
    assert "--time-limit-s is 0.0, allowed is" in " ".join(capfd.readouterr().err.split())


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("{run} --seed 3", "--seed is 3, but"),
        ("{run} --speed 0.5", "--speed is 0.5, but"),
        ("{run} --track zigzag", "flown again unchanged"),
        ("race --pick failed", "--pick is failed, but race is not a finished run"),
        ("race-paper --difficulty 0 --speed 0.4", "--speed 0.4: race-paper takes no speed"),
        ("race --difficulty 0 --speed 1.4", "--speed is 1.4"),
    ],
)
def test_options_that_do_not_fit_are_refused(line, words, tmp_path, capsys):
    (tmp_path / "trials.parquet").touch()
    args = line.format(run=tmp_path).split()
    assert cli.main(["view", *args, "--out", str(tmp_path)]) == 2
    assert words in " ".join(capsys.readouterr().err.split())


def test_a_recording_shows_who_flew_and_asks_for_a_speed(pilots, tmp_path):
    seen = tmp_path / "seen"
    asked = ["view", pilots["other"], "--track", "zigzag", "--count", "1", "--out", str(seen)]
    assert cli.main(asked) == 0
    found = columns(seen / "trials.rrd")
    eye = "/trial_0/world/drone/camera"
    assert found[eye, "Pinhole:resolution"][1] == [[[36.0, 20.0]]]
    layout = found[f"{eye}/depth", "DepthImage:format"][1][0][0]
    assert (layout["width"], layout["height"]) == (36, 20)
    evaluation, *_ = view._choose_trials(view.Config(run="race", speed=0.4))
    assert manners(evaluation.speed, monitor=False) == [Manner(speed=0.4)]


def test_view_of_something_else_is_refused(tmp_path, capsys):
    (tmp_path / "begun").mkdir()
    (tmp_path / "begun" / "journal-0.jsonl").write_text("{}\n")
    assert cli.main(["view", str(tmp_path / "begun")]) == 2
    assert "not finished; repeat its command" in " ".join(capsys.readouterr().err.split())
    (tmp_path / "trials.parquet").write_text("no parquet")
    assert cli.main(["view", str(tmp_path)]) == 2
    assert "run.json" in capsys.readouterr().err

"""suite view flies judged trials again."""

import json
import shutil
from pathlib import Path

import eval.judging.judge
from eval.judging.results import read_trials
from suite.commands import view
from suite.common.console import Quiet
from suite.judging.evaluate import evaluate as evaluate_here
from suite.judging.flying import Manner, manners
from suite.judging.replay import read_digests, read_evaluation
from suite.judging.requests import Evaluation
from tests.support.commands import answer, evaluate, refused, run
from tests.support.recordings import columns

ONE = "--track zigzag --trials 1 --policy"


def test_view_flies_the_chosen_trials_again(pilots, tmp_path, capfd):
    out, seen = tmp_path / "out", tmp_path / "seen"
    assert evaluate(out, "--track ellipse --trials 2 --seed 2 --policy", pilots["diver"]) == 0
    again = ("view --out", seen, out)
    said = answer(capfd, *again, *"--pick failed --count 1 --gif".split())
    names = sorted(path.name for path in seen.iterdir())
    assert names == ["ellipse-0-2.gif", "ellipse-0-2.png", "trials.rrd"]
    rows = read_trials(out / "trials.parquet")
    assert said["trials"][0]["time_s"] == rows[0].time_s
    assert "--pick passed" in refused(capfd, *again, "--pick", "passed")
    # A finished evaluation keeps trials of an earlier command in a journal.
    (out / "journal-0.jsonl").write_text("{}\n")
    assert run(*again, *"--count 1".split()) == 0


def test_view_finds_the_trials_of_every_policy_of_a_run(pilots, tmp_path, capfd):
    """The first one is often `race`, and the one that fails the user's own."""
    out, again = tmp_path / "out", ("view --out", tmp_path / "seen", tmp_path / "out")
    policies = ("--policy", pilots["pursuit"], pilots["diver"], pilots["diver2"])
    assert evaluate(out, "--trials 1 --track zigzag", *policies) == 0
    assert run(*again, "--pick", "failed") == 0
    said = capfd.readouterr().err
    assert f"flying 1 trial of {pilots['diver']} again" in said
    assert f"--policy selects another of: {pilots['diver2']}" in said
    shown = answer(capfd, *again, "--policy", pilots["diver2"])["trials"]
    assert shown[0]["pos_x"] == read_trials(out / "trials.parquet")[2].pos_x
    said = refused(capfd, *again, *"--pick failed --policy pursuit".split())
    assert "--pick failed" in said and "no such trial of pursuit" in said
    assert "unknown --policy 'rac'" in refused(capfd, *again, "--policy", "rac")


def test_view_flies_at_the_speed_of_the_shown_trials(pilots, tmp_path, monkeypatch):
    out = tmp_path / "out"
    assert evaluate(out, "--trials 1 --track zigzag --speed 0.4 0.7 --policy", pilots["other"]) == 0
    flown, fly = [], eval.judging.judge.fly
    monkeypatch.setattr(
        eval.judging.judge, "fly", lambda policy, *rest: flown.append(policy) or fly(policy, *rest)
    )
    assert run("view --policy other@0.7 --out", tmp_path / "seen", out) == 0
    assert [policy.spec.speed for policy in flown] == [0.7]


def test_a_run_whose_files_have_changed_is_not_flown_again(
    pilots, tmp_path, root, monkeypatch, capsys
):
    """It would show flights that nobody judged."""
    files = {"policy": Path(pilots["diver"])}
    files["vehicle"] = Path(shutil.copy(root / "eval/vehicles/racer5.toml", tmp_path))
    files["track"] = shutil.copytree(root / "tracks/examples", tmp_path / "tracks") / "yard.toml"
    flown = [text for name, file in files.items() for text in (f"--{name}", file)]
    out, again = tmp_path / "out", ("view --out", tmp_path / "seen", tmp_path / "out")
    assert evaluate(out, "--trials 1 --time-limit-s 0.5", *flown) == 0
    for what in ("vehicle", "track"):
        files[what].write_text(f"# a comment\n{files[what].read_text()}")
    assert run(*again) == 0
    monkeypatch.setattr(eval.judging.judge, "fly", None)
    for what, was, now in (
        ("policy", "diver", "another"),
        ("vehicle", "mass = 0.75", "mass = 0.85"),
        ("track", "width = 1.1", "width = 1.2"),
    ):
        old = files[what].read_text()
        assert was in old
        files[what].write_text(old.replace(was, now, 1))
        said = refused(capsys, *again)
        assert f"{what} {files[what]}: has changed since these trials were judged" in said
        assert "restore the judged version" in said
        files[what].write_text(old)


def test_a_run_of_an_earlier_version_is_held_to_its_policy(pilots, tmp_path, capsys):
    out, path = tmp_path / "out", tmp_path / "out" / "summary.json"
    assert evaluate(out, ONE, pilots["diver"]) == 0
    digests, summary = read_digests(out), json.loads(path.read_text())
    del summary["sha256"]
    path.write_text(json.dumps(summary))
    assert read_digests(out) == {"policy": digests["policy"]} != digests
    for policies, words in (
        ([], "does not say which policy was judged"),
        ([{"sha256": "another"}], f"policy {pilots['diver']}: has changed"),
    ):
        path.write_text(json.dumps({**summary, "policies": policies}))
        assert words in refused(capsys, "view --out", tmp_path / "seen", out)


def test_a_run_from_python_with_a_whole_number_of_seconds_is_read_again(pilots, tmp_path):
    asked = Evaluation(policies=(pilots["diver"],), track="zigzag", trials=1, time_limit_s=1)
    evaluate_here(asked, tmp_path / "out", Quiet())
    assert read_evaluation(tmp_path / "out") == asked


def test_a_run_does_not_say_itself_that_it_is_to_be_trusted(pilots, tmp_path, capsys):
    """What `suite view` is given may come from anywhere, and name a program."""
    out, program = tmp_path / "out", tmp_path / "policy.c"
    assert evaluate(out, ONE, pilots["diver"]) == 0
    program.write_text("this is no C, and nobody is to compile it")
    record = json.loads((out / "run.json").read_text())
    record["config"] |= {"policies": [str(program)], "trust": True}
    (out / "run.json").write_text(json.dumps(record))
    again = ("view --out", tmp_path / "seen", out)
    assert "if you trust its author, pass --trust" in refused(capsys, *again)
    assert run(*again, "--trust") == 2
    assert "pass --trust" not in capsys.readouterr().err


def test_a_trial_ends_at_the_time_that_is_given_and_is_seen_so_again(pilots, tmp_path, capfd):
    out, logs = tmp_path / "out", tmp_path / "logs"
    asked = ("--time-limit-s 0.6", *ONE.split(), pilots["pursuit"])
    assert evaluate(out, *asked) == 0
    (row,) = read_trials(out / "trials.parquet")
    assert (row.ended_by, row.time_s) == ("timeout", 0.6)
    assert run("view --out", tmp_path / "seen", out) == 0
    assert "timeout after 0.6 s" in capfd.readouterr().out
    assert run("collect --difficulty 0 --out", logs, *asked[0].split(), *asked[1:]) == 0
    listed = json.loads((logs / "flights.json").read_text())
    assert [flight["time_s"] for flight in listed["flights"]] == [0.6]
    words = refused(capfd, "eval --time-limit-s 0 --out", out, *asked[1:])
    assert "--time-limit-s is 0.0, allowed is" in words


def test_options_that_do_not_fit_and_what_is_no_finished_run_are_refused(tmp_path, capsys):
    (tmp_path / "trials.parquet").touch()
    for line, words in (
        (f"{tmp_path} --seed 3", "--seed is 3, but"),
        (f"{tmp_path} --speed 0.5", "--speed is 0.5, but"),
        (f"{tmp_path} --track zigzag", "flown again unchanged"),
        ("race --pick failed", "--pick is failed, but race is not a finished run"),
        ("race --policy race", "--policy is race, but race is not a finished run"),
        ("race-paper --difficulty 0 --speed 0.4", "--speed 0.4: race-paper takes no speed"),
        ("race --difficulty 0 --speed 1.4", "--speed is 1.4"),
    ):
        assert words in refused(capsys, f"view --out {tmp_path} {line}")
    (tmp_path / "begun").mkdir()
    (tmp_path / "begun" / "journal-0.jsonl").write_text("{}\n")
    assert "not finished; repeat its command" in refused(capsys, "view", tmp_path / "begun")
    (tmp_path / "trials.parquet").write_text("no parquet")
    assert "run.json" in refused(capsys, "view", tmp_path)


def test_a_recording_shows_who_flew_and_asks_for_a_speed(pilots, tmp_path):
    assert run("view --track zigzag --count 1 --out", tmp_path / "seen", pilots["other"]) == 0
    found = columns(tmp_path / "seen" / "trials.rrd")
    eye = "/trial_0/world/drone/camera"
    assert found[eye, "Pinhole:resolution"][1] == [[[36.0, 20.0]]]
    layout = found[f"{eye}/depth", "DepthImage:format"][1][0][0]
    assert (layout["width"], layout["height"]) == (36, 20)
    evaluation, *_ = view._choose_trials(view.Config(run="race", speed=0.4), Quiet())
    assert manners(evaluation.speed, monitor=False) == [Manner(speed=0.4)]

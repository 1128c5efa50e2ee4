"""suite eval, flown by pilots that need no training, and suite view, which flies trials again."""

import json
import shutil
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

import eval.judging.judge
import suite.judging.evaluate
from eval.judging.results import read_trials
from suite.commands import view
from suite.common.console import Console, Quiet
from suite.common.errors import FAILED
from suite.judging.content import PolicyContent, policy_digest
from suite.judging.evaluate import evaluate as evaluate_here
from suite.judging.flying import Manner, load_in_manner, manners, policy_for_workers
from suite.judging.replay import read_evaluation
from suite.judging.requests import Evaluation
from tests.support.commands import answer, evaluate, refused, run
from tests.support.judged_cells import cut_short
from tests.support.recordings import columns

COURSE = "[[gates]]\ncenter = [{}, 0.0, 1.3]\nwidth = 1.1\nheight = 1.0\n"


@pytest.fixture
def unpainted(monkeypatch):
    """Draw no pictures, which take longer than short flights and have tests of their own."""
    monkeypatch.setattr("eval.view.picture.write_picture", lambda path, *_: path)


def printed(capture):
    return " ".join("".join(capture.readouterr()).split())


def test_eval_writes_the_tables_and_says_them(pilots, tmp_path, capfd):
    out = tmp_path / "out"
    line = "eval --difficulty 0 --track zigzag --trials 2 --seed 5 --time-limit-s 1.5 --policy"
    said = answer(capfd, line, pilots["pursuit"], pilots["diver"], "--out", out)
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
    caption = (out / "table.md").read_text().splitlines()[0]
    said = "Vehicle reference, sensors perfect, simulator mujoco, seeds 5 to 6, time limit 1.5 s."
    assert caption == said
    header = json.loads(pq.read_schema(out / "trials.parquet").metadata[b"suite"])
    assert set(header) >= {"schema", "suite_version", "git_commit", "seed"}


def test_trials_on_planned_tracks_are_counted_for_the_vehicle_of_the_plans(pilots, tmp_path):
    """The ratio of laps to plans is tested with plenty of rows in tests/eval/judging."""
    for vehicle, planned in (("reference", [1]), ("racer5", [])):
        asked = f"--track circular --trials 2 --seed 1 --time-limit-s 0.1 --vehicle {vehicle}"
        assert evaluate(tmp_path / vehicle, f"{asked} --policy", pilots["pursuit"]) == 0
        summary = json.loads((tmp_path / vehicle / "summary.json").read_text())
        assert [laps["planned"] for laps in summary["over_plan"]] == planned


def test_a_policy_that_its_training_replaces_during_the_flights_is_recorded_as_flown(
    pilots, tmp_path, monkeypatch
):
    policy, fly, flown = pilots["diver"], eval.judging.judge.fly, []
    digest, content = policy_digest(policy), Path(policy).read_bytes()

    def replaced(make, trials, *rest):
        Path(policy).write_text("after further iterations")
        flown.append(make.args[0].files)
        return fly(load_in_manner(policy, False), trials, *rest)

    monkeypatch.setattr(eval.judging.judge, "fly", replaced)
    assert evaluate(tmp_path / "out", "--track zigzag --trials 1 --workers 2 --policy", policy) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [one["sha256"] for one in summary["policies"]] == [digest] != [policy_digest(policy)]
    assert flown == [(("diver", content),)]


def test_what_a_folder_holds_is_not_written_over_without_a_word(pilots, tmp_path, capsys):
    asked = ("--time-limit-s 0.1 --track zigzag --policy", pilots["diver"], "--trials")
    assert evaluate(tmp_path, *asked, 1) == 0
    assert "overwritten" not in printed(capsys)
    assert evaluate(tmp_path, *asked, 1) == 0
    assert "holds an evaluation; its results will be overwritten" in printed(capsys)
    for words, said in (
        ((2,), "trials is 1 there, 2 here"),
        ((1, "--seed", 3), "seed is 0 there, 3 here"),
        ((1, "--policy", pilots["other"]), "policies is"),
    ):
        line = f"eval --difficulty 0 --out {tmp_path} {' '.join(asked)}"
        told = refused(capsys, line, *words)
        assert said in told and "give another --out" in told
    said = refused(capsys, "collect --out", tmp_path, "--policy", pilots["diver"])
    assert "holds a run of another kind" in said


def test_an_interrupted_eval_goes_on_to_the_same_result(pilots, tmp_path, monkeypatch, capfd):
    asked = ("--track circular,zigzag --trials 1 --time-limit-s 0.1 --policy", pilots["pursuit"])
    whole, again = tmp_path / "whole", tmp_path / "again"
    assert evaluate(whole, *asked) == 0
    flown = cut_short(monkeypatch, stop_after=1)
    assert evaluate(again, *asked) == 130
    assert not (again / "trials.parquet").exists()
    with monkeypatch.context() as patch:
        patch.setattr(suite.judging.evaluate, "engines", lambda: {"numpy": "another"}, False)
        assert evaluate(again, *asked) == 2 and len(flown) == 1
    assert evaluate(again, *asked) == 0
    assert len(flown) == len(set(flown)) == 2, "no trial is flown twice"
    assert "flown before: 1 trial" in printed(capfd)
    assert read_trials(again / "trials.parquet") == read_trials(whole / "trials.parquet")


@pytest.mark.extended
def test_trials_flown_before_under_another_label_are_the_same_policys(
    pilots, tmp_path, monkeypatch
):
    """Alone a policy is called by its name, beside a namesake by its path."""
    asked = ("--track zigzag --trials 2 --policy", pilots["diver"])
    with monkeypatch.context() as patch:
        cut_short(patch, stop_after=1)
        assert evaluate(tmp_path, *asked) == 130
    (tmp_path / "journal-2.jsonl").write_text("of a command with more policies\n")
    assert evaluate(tmp_path, *asked, pilots["diver2"]) == 0
    assert not list(tmp_path.glob("journal-*.jsonl")), "suite view takes it for finished"
    rows = read_trials(tmp_path / "trials.parquet")
    assert [row.policy for row in rows] == [pilots[p] for p in ("diver", "diver2") for _ in "ab"]


def test_a_later_policys_journal_is_looked_at_before_the_first_flight(
    pilots, tmp_path, monkeypatch, capsys
):
    """The first policy's trials may take hours."""
    out, asked = tmp_path / "out", "--time-limit-s 0.1 --track zigzag --trials 1 --policy"
    with monkeypatch.context() as patch:
        cut_short(patch, stop_after=2)
        assert evaluate(out, asked, pilots["diver"], pilots["other"]) == 130
    (out / "journal-0.jsonl").unlink()
    monkeypatch.setattr(eval.judging.judge, "fly", None)
    both = (pilots["diver"], pilots["pursuit"])
    said = refused(capsys, f"eval --difficulty 0 --out {out} {asked}", *both)
    assert "journal-1.jsonl: holds trials flown otherwise" in said and "another --out" in said
    assert [path.name for path in out.iterdir()] == ["journal-1.jsonl"]


def test_what_cannot_be_used_is_said_before_the_first_flight(pilots, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(eval.judging.judge, "fly", None)
    for line, words in (
        ("--track zigzg", "Did you mean 'zigzag'?"),
        ("--track no_such.toml", "no_such.toml"),
        ("--simulator mujco", "Did you mean 'mujoco'?"),
        ("--vehicle referense", "Did you mean 'reference'?"),
        ("--policy nobody_we_know", "nobody_we_know"),
        # What tables would take for one.
        (f"--policy {pilots['other']} --track zigzag --speed 0.5 0.5", "judged twice; give each"),
        (f"--policy {pilots['other']} --speed 0.5 0.50000001", "other@0.5 would be judged twice"),
    ):
        given = "" if "--policy" in line else f"--policy {pilots['diver']}"
        assert words in refused(capsys, f"eval --out {tmp_path / 'out'} {line} {given}")
        assert not (tmp_path / "out").exists()


def test_with_a_monitor_each_policy_flies_twice_on_the_same_trials(pilots, tmp_path, monkeypatch):
    assert evaluate(tmp_path, "--monitor --track zigzag --trials 1 --policy", pilots["diver"]) == 0
    table = (tmp_path / "table.md").read_text()
    assert "| diver | zigzag" in table and "| diver+monitor | zigzag" in table
    loaded = load_in_manner(pilots["diver"], False, Manner(monitored=True))
    monkeypatch.setattr("suite.judging.content.load_policy", lambda *_: loaded.policy)
    content = PolicyContent.of(pilots["diver"])
    make = policy_for_workers(loaded, content, 2, Manner(monitored=True))
    assert callable(make) and make().name == "diver+monitor"


@pytest.mark.slow
def test_the_mjx_world_flies_more_trials_than_it_has_slots(pilots, tmp_path):
    ends = []
    for world in ("mjx", "mujoco"):
        asked = f"eval --difficulty 0 --track zigzag --trials 150 --simulator {world} --policy"
        assert run(asked, pilots["diver"], "--out", tmp_path / world) == 0
        ends.append([row.ended_by for row in read_trials(tmp_path / world / "trials.parquet")])
    assert len(ends[0]) == 150 and ends[0] == ends[1]


def test_trials_that_are_not_asked_for_again_are_kept_and_said(pilots, tmp_path, capsys):
    """A command that goes on with fewer trials must not lose what the first one has flown."""
    asked = ("--track zigzag --policy", pilots["diver"], "--trials")
    with pytest.MonkeyPatch.context() as patch:
        cut_short(patch, stop_after=3)
        assert evaluate(tmp_path, *asked, 4) == 130
    capsys.readouterr()
    shown = []

    @contextmanager
    def progress(self, label, total, begun=0.0):
        yield lambda done, note: shown.append((begun, done, total, note))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Console, "progress", progress)
        assert evaluate(tmp_path, *asked, 2, "--seed", 2) == 0
    said = "2 further trials were flown before, which this command does not request"
    assert said in printed(capsys)
    assert shown == [(1, 2, 2, "0% success")]
    assert [row.seed for row in read_trials(tmp_path / "trials.parquet")] == [2, 3]
    assert evaluate(tmp_path, *asked, 4) == 0
    text = printed(capsys)
    assert "flown before: 4 trials" in text and "exceeded the limits" not in text
    seeds = [row.seed for row in read_trials(tmp_path / "trials.parquet")]
    assert seeds == [0, 1, 2, 3] and not list(tmp_path.glob("journal*"))


ONE = "--track zigzag --trials 1 --policy"


def test_view_flies_the_chosen_trials_again(pilots, tmp_path, monkeypatch, capfd, request):
    out, seen = tmp_path / "out", tmp_path / "seen"
    asked = "--track ellipse --trials 2 --seed 2 --time-limit-s 2 --policy"
    assert evaluate(out, asked, pilots["diver"]) == 0
    again = ("view --out", seen, out)
    said = answer(capfd, *again, *"--pick failed --count 1 --gif".split())
    names = sorted(path.name for path in seen.iterdir())
    assert names == ["ellipse-0-2.gif", "ellipse-0-2.png", "trials.rrd"]
    rows = read_trials(out / "trials.parquet")
    assert said["trials"][0]["time_s"] == rows[0].time_s
    assert "--pick passed" in refused(capfd, *again, "--pick", "passed")
    # A finished evaluation keeps trials of an earlier command in a journal.
    (out / "journal-0.jsonl").write_text("{}\n")
    request.getfixturevalue("unpainted")
    assert run(*again, *"--count 1".split()) == 0
    assert "was judged as" not in capfd.readouterr().err
    cut_short(monkeypatch, seconds=0.1)  # as a machine on which the trial ends otherwise
    assert run(*again, *"--count 1".split()) == 0
    assert "ellipse-0-2 was judged as collision after" in capfd.readouterr().err


@pytest.mark.slow
def test_view_finds_the_trials_of_every_policy_of_a_run(pilots, tmp_path, capfd):
    """The first one is often `race`, and the one that fails the user's own."""
    out, again = tmp_path / "out", ("view --out", tmp_path / "seen", tmp_path / "out")
    policies = ("--policy", pilots["pursuit"], pilots["diver"], pilots["diver2"])
    assert evaluate(out, "--trials 1 --track zigzag --time-limit-s 20", *policies) == 0
    assert "expect no difference" not in capfd.readouterr().err
    assert run(*again[:-1], out / "trials.parquet", "--pick", "failed") == 0
    said = capfd.readouterr().err
    assert f"flying 1 trial of {pilots['diver']}" in said
    assert f"--policy selects another of: {pilots['diver2']}" in said
    shown = answer(capfd, *again, "--policy", pilots["diver2"])["trials"]
    assert shown[0]["pos_x"] == read_trials(out / "trials.parquet")[2].pos_x
    said = refused(capfd, *again, *"--pick failed --policy pursuit".split())
    assert "--pick failed" in said and "no such trial of pursuit" in said
    assert "unknown --policy 'rac'" in refused(capfd, *again, "--policy", "rac")


@pytest.mark.extended
def test_view_flies_at_the_speed_of_the_shown_trials(pilots, tmp_path, monkeypatch, unpainted):
    out = tmp_path / "out"
    assert evaluate(out, "--trials 1 --track zigzag --speed 0.4 0.7 --policy", pilots["other"]) == 0
    flown, fly = [], eval.judging.judge.fly
    monkeypatch.setattr(
        eval.judging.judge, "fly", lambda policy, *rest: flown.append(policy) or fly(policy, *rest)
    )
    assert run("view --policy other@0.7 --out", tmp_path / "seen", out) == 0
    assert [policy.spec.speed for policy in flown] == [0.7]


def test_a_run_whose_files_have_changed_is_not_flown_again(
    pilots, tmp_path, root, monkeypatch, capsys, unpainted
):
    """It would show flights that nobody judged."""
    files = {"policy": Path(pilots["diver"]), "track": tmp_path / "course.toml"}
    files["track"].write_text(COURSE.format(0.0) + COURSE.format(5.0))
    files["vehicle"] = Path(shutil.copy(root / "eval/vehicles/racer5.toml", tmp_path))
    files["sensors"] = Path(shutil.copy(root / "eval/sensors/presets/vio.toml", tmp_path))
    flown = [text for name, file in files.items() for text in (f"--{name}", file)]
    out, again = tmp_path / "out", ("view --out", tmp_path / "seen", tmp_path / "out")
    assert evaluate(out, "--trials 1", *flown) == 0
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
    files["sensors"].write_text('name = "vio"\n')  # without any model
    assert f"sensors {files['sensors']}: has changed" in refused(capsys, *again)


def test_a_run_is_held_to_its_policy(pilots, tmp_path, capsys):
    out, path = tmp_path / "out", tmp_path / "out" / "summary.json"
    assert evaluate(out, ONE, pilots["diver"]) == 0
    summary = json.loads(path.read_text())
    for policies, words in (
        ([], "has no SHA-256 for each of the 1 policies"),
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


def test_a_trial_ends_at_the_time_that_is_given_and_is_seen_so_again(
    pilots, tmp_path, capfd, unpainted
):
    out, logs = tmp_path / "out", tmp_path / "logs"
    asked = ("--time-limit-s 0.2", *ONE.split(), pilots["pursuit"])
    assert evaluate(out, *asked) == 0
    (row,) = read_trials(out / "trials.parquet")
    assert (row.ended_by, row.time_s) == ("timeout", 0.2)
    assert run("view --out", tmp_path / "seen", out) == 0
    assert "timeout after 0.2 s" in capfd.readouterr().out
    assert run("collect --difficulty 0 --out", logs, *asked[0].split(), *asked[1:]) == FAILED
    listed = json.loads((logs / "flights.json").read_text())
    assert [flight["time_s"] for flight in listed["flights"]] == [0.2]
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
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "zigzag-0-3.parquet").touch()
    for given in (tmp_path / "logs", tmp_path / "logs" / "zigzag-0-3.parquet"):
        said = refused(capsys, "view", given)
        assert "zigzag-0-3.parquet is a flight log" in said and "give the policy" in said
    (tmp_path / "trials.parquet").write_text("no parquet")
    assert "run.json" in refused(capsys, "view", tmp_path)


def test_a_recording_shows_who_flew_and_asks_for_a_speed(pilots, tmp_path, unpainted):
    assert run("view --track zigzag --count 1 --out", tmp_path / "seen", pilots["other"]) == 0
    found = columns(tmp_path / "seen" / "trials.rrd")
    eye = "/trial_0/world/drone/camera"
    assert found[eye, "Pinhole:resolution"][1] == [[[36.0, 20.0]]]
    layout = found[f"{eye}/depth", "DepthImage:format"][1][0][0]
    assert (layout["width"], layout["height"]) == (36, 20)
    evaluation, *_ = view._choose_trials(view.Config(run="race", speed=0.4), Quiet())
    assert manners(evaluation.speed, monitor=False) == [Manner(speed=0.4)]


def test_levels_beyond_the_count_are_said_to_be_left_out(capsys):
    four = view.Config(run="race", track="ellipse,random", difficulty="1,8")
    assert len(view._choose_trials(four, Console()).trials) == 3
    assert "shown are 3 of 4 trials; --count shows more" in capsys.readouterr().err
    view._choose_trials(replace(four, count=4), Console())
    assert "shown" not in capsys.readouterr().err

"""suite eval, flown by pilots that need no training."""

import json

import pyarrow.parquet as pq
import pytest

import eval.judging.judge
import eval.logs.flight_log
from eval.judging.results import read_trials
from suite import cli
from suite.judging.flying import Manner, load_in_manner, policy_for_workers


def _eval(out, *args):
    args = args if "--difficulty" in args else (*args, "--difficulty", "0")
    return cli.main(["eval", "--out", str(out), *args])


def test_eval_writes_the_tables_and_says_them(pilots, tmp_path, capfd):
    out = tmp_path / "out"
    args = ["--track", "zigzag", "--trials", "2", "--seed", "5", "--time-limit-s", "3", "--json"]
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


def test_laps_are_compared_with_the_plans_of_their_tracks(pilots, tmp_path, capfd):
    asked = ["--policy", pilots["pursuit"], "--track", "circular", "--trials", "2", "--seed", "1"]
    assert _eval(tmp_path / "out", *asked) == 0
    said = " ".join(capfd.readouterr().out.split())
    (found,) = json.loads((tmp_path / "out" / "summary.json").read_text())["over_plan"]
    ratio = found["ratio"]
    assert found["planned"] == found["finished"] == 1 and 1.0 < ratio["value"] < 6.0
    assert f"laps take {ratio['value']:.2f}" in said and "lap (median of 1 track;" in said
    assert _eval(tmp_path / "racer5", *asked, "--vehicle", "racer5", "--time-limit-s", "1") == 0
    assert "planned lap" not in capfd.readouterr().out
    assert json.loads((tmp_path / "racer5" / "summary.json").read_text())["over_plan"] == []


def test_what_a_folder_holds_is_not_written_over_without_a_word(pilots, tmp_path, capsys):
    asked = ["--track", "zigzag", "--policy", pilots["diver"]]
    assert _eval(tmp_path, *asked, "--trials", "1") == 0
    assert "overwritten" not in capsys.readouterr().err
    assert _eval(tmp_path, *asked, "--trials", "2") == 0
    assert "holds an evaluation; its results will be overwritten" in _told(capsys)
    assert cli.main(["collect", "--out", str(tmp_path), "--policy", pilots["diver"]]) == 2
    assert "holds a run of another kind" in _told(capsys)


def _told(capsys):
    return " ".join(capsys.readouterr().err.split())


def test_an_interrupted_eval_goes_on_to_the_same_result(pilots, tmp_path, monkeypatch, capfd):
    args = ["--track", "circular,zigzag", "--trials", "1", "--policy", pilots["pursuit"]]
    args += ["--time-limit-s", "1"]
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
    assert len(flown) == len(set(flown)) == 2, "no trial is flown twice"
    assert "1 trials were flown before" in capfd.readouterr().err
    whole, again = (read_trials(tmp_path / name / "trials.parquet") for name in ("whole", "again"))
    assert again == whole


def test_trials_flown_before_under_another_label_are_the_same_policys(
    pilots, tmp_path, monkeypatch
):
    """Alone a policy is called by its name, beside a namesake by its path."""
    args = ["--track", "zigzag", "--trials", "2", "--policy", pilots["diver"]]
    fly = eval.judging.judge.fly

    def one_only(policy, trials, vehicle, world, options, on_result, **rest):
        def keep(result, flight):
            on_result(result, flight)
            raise KeyboardInterrupt

        return fly(policy, trials, vehicle, world, options, keep, **rest)

    with monkeypatch.context() as patch:
        patch.setattr(eval.judging.judge, "fly", one_only)
        assert _eval(tmp_path / "out", *args) == 130
    (tmp_path / "out" / "journal-2.jsonl").write_text("of a command with more policies\n")
    assert _eval(tmp_path / "out", *args, "--policy", pilots["diver2"]) == 0
    assert not list((tmp_path / "out").glob("journal-*.jsonl")), "suite view takes it for finished"
    rows = read_trials(tmp_path / "out" / "trials.parquet")
    assert [row.policy for row in rows] == [pilots[p] for p in ("diver", "diver2") for _ in "ab"]


def test_a_journal_of_something_else_is_not_mixed_in(pilots, tmp_path, monkeypatch, capsys):
    def interrupted(*args, **rest):
        raise KeyboardInterrupt

    args = ["--track", "zigzag", "--trials", "1"]
    with monkeypatch.context() as patch:
        patch.setattr(eval.judging.judge, "fly", interrupted)
        assert _eval(tmp_path / "out", *args, "--policy", pilots["pursuit"]) == 130
    assert _eval(tmp_path / "out", *args, "--policy", pilots["diver"]) == 2
    assert "another --out" in capsys.readouterr().err


def test_a_later_policys_journal_is_looked_at_before_the_first_flight(
    pilots, tmp_path, monkeypatch, capsys
):
    """The first policy's trials may take hours."""

    def interrupted(policy, *args, **rest):
        if policy.name == "other":
            raise KeyboardInterrupt
        return fly(policy, *args, **rest)

    fly, asked = eval.judging.judge.fly, ["--track", "zigzag", "--trials", "1", "--policy"]
    with monkeypatch.context() as patch:
        patch.setattr(eval.judging.judge, "fly", interrupted)
        out = tmp_path / "out"
        assert _eval(out, *asked, pilots["diver"], "--policy", pilots["other"]) == 130
    (out / "journal-0.jsonl").unlink()
    monkeypatch.setattr(eval.judging.judge, "fly", None)
    assert _eval(out, *asked, pilots["diver"], "--policy", pilots["pursuit"]) == 2
    assert "journal-1.jsonl: holds trials flown otherwise" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["journal-1.jsonl"]


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--trials", "0"], "--trials is 0, allowed is 1 to 100000"),
        (["--seed", "-1"], "--seed is -1"),
        (["--difficulty", "10"], "level 10 is not 0 to 9"),
        (["--track", "zigzg"], "Did you mean 'zigzag'?"),
        (["--track", "no_such.toml"], "no_such.toml"),
        (["--simulator", "mujco"], "Did you mean 'mujoco'?"),
        (["--vehicle", "referense"], "Did you mean 'reference'?"),
        (["--policy", "nobody_we_know"], "nobody_we_know"),
        (["--rerun", "trials.mp4"], "must end in .rrd"),
        (["--rerun", "trials.rrd", "--simulator", "reference"], "'reference' records no flights"),
        (["--rerun", "/proc/nowhere/trials.rrd"], "/proc/nowhere"),
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


def test_with_a_monitor_each_policy_flies_twice_on_the_same_trials(pilots, tmp_path):
    asked = ["--policy", pilots["diver"], "--monitor", "--track", "zigzag", "--trials", "1"]
    assert _eval(tmp_path / "out", *asked) == 0
    table = (tmp_path / "out" / "table.md").read_text()
    assert "| diver | zigzag" in table and "| diver+monitor | zigzag" in table
    loaded = load_in_manner(pilots["diver"], False, Manner(monitored=True))
    make = policy_for_workers(loaded, pilots["diver"], False, 2, Manner(monitored=True))
    assert callable(make) and make().name == "diver+monitor"


def test_what_tables_would_take_for_one_is_refused(pilots, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(eval.judging.judge, "fly", None)
    for speeds in (["0.5", "0.5"], ["0.5", "0.50000001"]):
        asked = ["--policy", pilots["other"], "--track", "zigzag", "--speed", *speeds]
        assert _eval(tmp_path / "out", *asked) == 2
        assert "other@0.5 would be judged twice; give each" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_the_mjx_world_flies_more_trials_than_it_has_slots(pilots, tmp_path):
    asked = ["--policy", pilots["diver"], "--track", "zigzag", "--trials", "150"]
    assert _eval(tmp_path / "mjx", *asked, "--simulator", "mjx") == 0
    assert _eval(tmp_path / "mujoco", *asked) == 0
    ends = [
        [row.ended_by for row in read_trials(tmp_path / world / "trials.parquet")]
        for world in ("mjx", "mujoco")
    ]
    assert len(ends[0]) == 150 and ends[0] == ends[1]


def test_trials_that_are_not_asked_for_again_are_kept_and_said(pilots, tmp_path, capsys):
    """A command that goes on with fewer trials must not lose what the first one has flown."""
    from eval.judging.results import Journal

    asked = ["--track", "zigzag", "--policy", pilots["diver"]]
    keep = Journal.append

    def three(self, result):
        keep(self, result)
        if len(self.done) == 3:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Journal, "append", three)
        assert _eval(tmp_path, *asked, "--trials", "4") == 130
    capsys.readouterr()
    assert _eval(tmp_path, *asked, "--trials", "1") == 0
    assert "2 further trials were flown before, which this command does not request" in _told(
        capsys
    )
    assert len(read_trials(tmp_path / "trials.parquet")) == 1
    assert _eval(tmp_path, *asked, "--trials", "4") == 0
    assert "3 trials were flown before" in _told(capsys)
    seeds = [row.seed for row in read_trials(tmp_path / "trials.parquet")]
    assert seeds == [0, 1, 2, 3] and not list(tmp_path.glob("journal*"))

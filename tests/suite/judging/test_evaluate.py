"""suite eval, flown by pilots that need no training."""

import json
from contextlib import contextmanager

import pyarrow.parquet as pq
import pytest

import eval.judging.judge
import suite.judging.evaluate
from eval.judging.results import read_trials
from suite.common.console import Console
from suite.judging.flying import Manner, load_in_manner, policy_for_workers
from tests.support.commands import answer, evaluate, refused, run
from tests.support.judged_cells import cut_short


def printed(capture):
    return " ".join("".join(capture.readouterr()).split())


def test_eval_writes_the_tables_and_says_them(pilots, tmp_path, capfd):
    out = tmp_path / "out"
    line = "eval --difficulty 0 --track zigzag --trials 2 --seed 5 --time-limit-s 3 --policy"
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
    header = json.loads(pq.read_schema(out / "trials.parquet").metadata[b"suite"])
    assert set(header) >= {"schema", "suite_version", "git_commit", "seed"}


def test_trials_on_planned_tracks_are_counted_for_the_vehicle_of_the_plans(pilots, tmp_path):
    """The ratio of laps to plans is tested with plenty of rows in tests/eval/judging."""
    for vehicle, planned in (("reference", [1]), ("racer5", [])):
        asked = f"--track circular --trials 2 --seed 1 --time-limit-s 0.1 --vehicle {vehicle}"
        assert evaluate(tmp_path / vehicle, f"{asked} --policy", pilots["pursuit"]) == 0
        summary = json.loads((tmp_path / vehicle / "summary.json").read_text())
        assert [laps["planned"] for laps in summary["over_plan"]] == planned


def test_what_a_folder_holds_is_not_written_over_without_a_word(pilots, tmp_path, capsys):
    asked = ("--track zigzag --policy", pilots["diver"], "--trials")
    assert evaluate(tmp_path, *asked, 1) == 0
    assert "overwritten" not in printed(capsys)
    assert evaluate(tmp_path, *asked, 2) == 0
    assert "holds an evaluation; its results will be overwritten" in printed(capsys)
    said = refused(capsys, "collect --out", tmp_path, "--policy", pilots["diver"])
    assert "holds a run of another kind" in said


def test_an_interrupted_eval_goes_on_to_the_same_result(pilots, tmp_path, monkeypatch, capfd):
    asked = ("--track circular,zigzag --trials 1 --time-limit-s 1 --policy", pilots["pursuit"])
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
    assert "1 trials were flown before" in printed(capfd)
    assert read_trials(again / "trials.parquet") == read_trials(whole / "trials.parquet")


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
    out, asked = tmp_path / "out", "--track zigzag --trials 1 --policy"
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
        ("--rerun trials.rrd --simulator reference", "'reference' records no flights"),
        ("--rerun /proc/nowhere/trials.rrd", "/proc/nowhere"),
        # What tables would take for one.
        (f"--policy {pilots['other']} --track zigzag --speed 0.5 0.5", "judged twice; give each"),
        (f"--policy {pilots['other']} --speed 0.5 0.50000001", "other@0.5 would be judged twice"),
    ):
        given = "" if "--policy" in line else f"--policy {pilots['diver']}"
        assert words in refused(capsys, f"eval --out {tmp_path / 'out'} {line} {given}")
        assert not (tmp_path / "out").exists()


def test_with_a_monitor_each_policy_flies_twice_on_the_same_trials(pilots, tmp_path):
    assert evaluate(tmp_path, "--monitor --track zigzag --trials 1 --policy", pilots["diver"]) == 0
    table = (tmp_path / "table.md").read_text()
    assert "| diver | zigzag" in table and "| diver+monitor | zigzag" in table
    loaded = load_in_manner(pilots["diver"], False, Manner(monitored=True))
    make = policy_for_workers(loaded, pilots["diver"], False, 2, Manner(monitored=True))
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
    assert "4 trials were flown before" in printed(capsys)
    seeds = [row.seed for row in read_trials(tmp_path / "trials.parquet")]
    assert seeds == [0, 1, 2, 3] and not list(tmp_path.glob("journal*"))

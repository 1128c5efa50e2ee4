"""Stages in folders, the record of a run, and the messages about both."""

import json
from dataclasses import dataclass

import pytest

from suite.common.console import Console, duration, size
from suite.common.provenance import refuse_other_run, run_record, write_run_record
from suite.common.stages import MARK, Estimate, Stage, announce, claim, run_stages
from suite.experiments.study.training import training_commit
from suite.judging.requests import Collection, Evaluation


@dataclass(frozen=True)
class Settings:
    trials: int = 3
    track: str = "zigzag"


def stages(done, broken=False):
    def work(name):
        def do(folder):
            if broken and name == "second":
                raise RuntimeError("cut off")
            folder.mkdir(parents=True, exist_ok=True)
            done.append(name)

        return do

    return [
        Stage(name, f"doing the {name}", Estimate(1.0, 1.0), work(name), lambda f: done.append(f))
        for name in ("first", "second")
    ]


def test_a_stage_is_done_once_and_told_again(tmp_path, capfd):
    done = []
    with pytest.raises(RuntimeError):
        run_stages(tmp_path, stages(done, broken=True), Console(), "the run")
    assert done == ["first", tmp_path / "first"] and not (tmp_path / "second" / MARK).exists()
    assert "the run: about 2.0 s" in capfd.readouterr().err
    done.clear()
    took = run_stages(tmp_path, stages(done), Console(), "the run")
    assert done == [tmp_path / "first", "second", tmp_path / "second"]
    assert list(took) == ["first", "second"]
    assert took["first"] == json.loads((tmp_path / "first" / MARK).read_text())["seconds"]
    said = capfd.readouterr().err
    assert "[1/2] doing the first: done before" in said and "[2/2] took" in said
    assert "the run: about 1.0 s" in said
    run_stages(tmp_path, stages([]), Console(), "the run")
    assert "about" not in capfd.readouterr().err


def test_a_folder_of_another_configuration_is_refused(tmp_path):
    claim(tmp_path, Settings(), 0)
    claim(tmp_path, Settings(), 0)
    with pytest.raises(ValueError, match="trials is 3 there, 5 here.*another --out"):
        claim(tmp_path, Settings(trials=5), 0)
    with pytest.raises(ValueError, match=r"there, 'xxx.{,50}\(902 characters\) here\); give"):
        claim(tmp_path, Settings(track="x" * 900), 0)
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(ValueError, match="not the record of a run"):
        claim(tmp_path, Settings(), 0)


def test_an_estimate_is_said_in_figures_for_people_and_missing_memory_is_warned_of(capsys):
    announce(Console(), "training", Estimate(seconds=130, memory_bytes=2e9))
    assert capsys.readouterr().err == "training: about 2 min 10 s and 2.0 GB of memory\n"
    announce(Console(), "training", Estimate(seconds=1, memory_bytes=1e18))
    assert "warning" in capsys.readouterr().err
    durations = ["0.4 s", "10 s", "1 min 00 s", "3 min 20 s", "2 h 05 min"]
    assert [duration(s) for s in (0.44, 9.96, 59.6, 200, 7500)] == durations
    assert [size(b) for b in (5, 812e3, 2.06e9)] == ["5 B", "812 kB", "2.1 GB"]


def test_a_run_record_holds_what_is_needed_to_repeat_it(tmp_path):
    config = Estimate(seconds=1.0, memory_bytes=2.0)
    write_run_record(tmp_path, config, seed=3)
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["config"] == {"seconds": 1.0, "memory_bytes": 2.0}
    assert record["seed"] == 3 and record["schema"] == 1
    assert set(record) >= {"suite_version", "git_commit", "python", "packages", "machine"}
    assert run_record(config, None)["config_type"] == "suite.common.stages.Estimate"


def test_a_run_that_goes_on_keeps_the_commits_that_made_it(tmp_path, monkeypatch):
    for commit in ("aaa", "aaa", "bbb"):
        monkeypatch.setattr(
            "suite.common.provenance.stamp", lambda c=commit, **_: {"git_commit": c}
        )
        write_run_record(tmp_path, Estimate(1.0, 2.0), seed=3, resumed=True)
    assert json.loads((tmp_path / "run.json").read_text())["earlier_commits"] == ["aaa"]
    assert training_commit(tmp_path / "policy") == "aaa, bbb"
    write_run_record(tmp_path, Estimate(1.0, 2.0), seed=3)
    assert training_commit(tmp_path / "policy") == "bbb", "another run in the same folder"
    assert training_commit(tmp_path / "none" / "policy") == "unknown"


def test_a_folder_of_another_kind_of_run_is_refused(tmp_path):
    refuse_other_run(tmp_path, Evaluation())  # nothing is there
    write_run_record(tmp_path, Evaluation(), 0)
    refuse_other_run(tmp_path, Evaluation(trials=3))
    with pytest.raises(ValueError, match="holds a run of another kind .* give another --out"):
        refuse_other_run(tmp_path, Collection())
    (tmp_path / "run.json").write_text("[]")
    refuse_other_run(tmp_path, Collection())  # none of ours


def test_progress_without_a_terminal_is_a_plain_line_now_and_then(capsys):
    now = [0.0]
    with Console().progress("flying", 100, clock=lambda: now[0]) as update:
        for done in range(101):
            now[0] = done * 0.5
            update(done, "3.1 m/s")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 5
    assert lines[0] == "flying: 20 of 100, 40 s left, 3.1 m/s"
    # Only what was done since it began counts.
    now[0] = 0.0
    with Console().progress("training", 100, clock=lambda: now[0], begun=80) as update:
        now[0] = 12.0
        update(90)
    assert capsys.readouterr().err == "training: 90 of 100, 12 s left\n"

"""The record of a run."""

import json

import pytest

from suite.common.provenance import refuse_other_run, run_record, write_run_record
from suite.common.stages import Estimate
from suite.judging.requests import Collection, Evaluation


def test_a_run_record_holds_what_is_needed_to_repeat_it(tmp_path):
    config = Estimate(seconds=1.0, memory_bytes=2.0)
    write_run_record(tmp_path, config, seed=3)
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["config"] == {"seconds": 1.0, "memory_bytes": 2.0}
    assert record["seed"] == 3 and record["schema"] == 1
    assert set(record) >= {"suite_version", "git_commit", "python", "packages", "machine"}
    assert run_record(config, None)["config_type"] == "suite.common.stages.Estimate"


def test_a_folder_of_another_kind_of_run_is_refused(tmp_path):
    refuse_other_run(tmp_path, Evaluation())  # nothing is there
    write_run_record(tmp_path, Evaluation(), 0)
    refuse_other_run(tmp_path, Evaluation(trials=3))
    with pytest.raises(ValueError, match="holds a run of another kind .* give another --out"):
        refuse_other_run(tmp_path, Collection())
    (tmp_path / "run.json").write_text("[]")
    refuse_other_run(tmp_path, Collection())  # none of ours


def test_a_run_that_goes_on_keeps_the_commits_that_made_it(tmp_path, monkeypatch):
    from suite.experiments.study.training import commit_of

    for commit in ("aaa", "aaa", "bbb"):
        monkeypatch.setattr(
            "suite.common.provenance.stamp", lambda c=commit, **_: {"git_commit": c}
        )
        write_run_record(tmp_path, Estimate(1.0, 2.0), seed=3, goes_on=True)
    assert json.loads((tmp_path / "run.json").read_text())["earlier_commits"] == ["aaa"]
    assert commit_of(tmp_path / "policy") == "aaa, bbb"
    write_run_record(tmp_path, Estimate(1.0, 2.0), seed=3)
    assert commit_of(tmp_path / "policy") == "bbb", "another run in the same folder"
    assert commit_of(tmp_path / "none" / "policy") == "unknown"

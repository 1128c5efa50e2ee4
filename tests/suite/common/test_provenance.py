"""The record of a run."""

import json

from suite.common.estimate import Estimate
from suite.common.provenance import run_record, write_run_record


def test_a_run_record_holds_what_is_needed_to_repeat_it(tmp_path):
    config = Estimate(seconds=1.0, memory_bytes=2.0)
    write_run_record(tmp_path, config, seed=3)
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["config"] == {"seconds": 1.0, "memory_bytes": 2.0}
    assert record["seed"] == 3 and record["schema"] == 1
    assert set(record) >= {"suite_version", "git_commit", "python", "packages", "machine"}
    assert run_record(config, None)["config_type"] == "suite.common.estimate.Estimate"


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

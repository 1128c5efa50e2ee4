"""The benchmark of the judge, on a few short trials of a small policy."""

import json

from suite import cli
from suite.experiments.bench import judge
from tests.support.small_policy import small_checkpoint


def test_both_sides_fly_the_same_trials_to_the_same_end(tmp_path, monkeypatch, capsys):
    folder, run = str(small_checkpoint(tmp_path)), judge.run
    monkeypatch.setattr(judge, "run", lambda: run(folder, trials=3, time_limit_s=0.2))
    assert cli.main(["bench", "judge", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["ours"]["value"] > 0 and answer["baseline"]["value"] > 0
    assert answer["ratio"] == answer["ours"]["value"] / answer["baseline"]["value"]
    assert answer["details"]["trials_that_end_alike"] == 3
    assert answer["details"]["images_a_trial"] > 1

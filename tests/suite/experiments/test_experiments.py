"""suite reproduce: help for every experiment, and options that are refused."""

import pytest

from suite import cli
from suite.experiments import EXPERIMENTS
from tests.support import commands


def test_every_experiment_is_listed_and_has_help_for_every_option(capsys):
    assert cli.main(["reproduce"]) == 0
    listed = capsys.readouterr().out
    for name in EXPERIMENTS:
        assert cli.main(["reproduce", name, "--help"]) == 0
        said = capsys.readouterr().out
        assert name in listed and f"suite reproduce {name} [-h]" in said and "--json" in said
        assert "--cache" in said.partition("advanced options")[2]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("table3", "unknown"),
        ("table2 --policy race-papr", "Did you mean 'race-paper'?"),
        ("table2 --policy nowhere/policy", "nowhere/policy: no such file"),
        ("simulators --policy {folder}/mine.pt2", "suite reproduce never does"),
        ("simulators --simulator reference", "reference: the page compares with mujoco"),
        ("simulators --simulator mjx --simulator mjx", "--simulator mjx is given twice"),
        ("robustness --only linear_darg", "Did you mean 'linear_drag'?"),
        ("robustness --policy race --policy race", "--policy race is given twice"),
        ("perception --only stero", "Did you mean 'stereo'?"),
        ("ablation --seed 0", "--seed 0 is one of --training-seeds"),
        ("ablation --only field@0.41", "Did you mean 'field 0.4'?"),
        ("ablation --set episode.batch=9", "this command sets episode.batch; give --worlds"),
        ("ablation --set seed=9", "this command sets seed; give --training-seeds"),
        ("ablation --set loss.jerk=1 loss.jerk=2", "'loss.jerk=2': loss.jerk is given twice"),
        ("ablation --set loss.field_gain=0", "loss.field_gain is 0, allowed is a number above"),
        ("ablation --worlds 5", "episode.batch is 5, allowed are multiples of episode.shards (2)"),
        ("ablation --recipe race-small", "--recipe race-small has 3 phases, allowed is a recipe"),
        ("ablation --workers 99", "--workers is 99"),
        ("schemes --training-seeds 1 1", "--training-seeds is 1 1"),
        ("schemes --worlds 5 --set episode.shards=1", "PPO are multiples of its 2 minibatches"),
        ("schemes --set loss.progress=1.2", "this command sets loss.progress; give --progress"),
        ("faults --workers 10.0.0.1:8786", "--workers is tcp://10.0.0.1:8786; allowed"),
        ("gpu", "JAX finds no GPU here"),
        ("gpu --worlds 4 8 --train-worlds 6", "allowed are those of --worlds: 4 8"),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_done(
    line, words, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("suite.train.run.train", None)
    monkeypatch.setattr("suite.experiments.study.judging.fly_share", None)
    program, place = tmp_path / "mine.pt2", tmp_path / "place"
    program.touch()
    place.mkdir()
    args = [word.replace("@", " ").format(folder=tmp_path) for word in line.split()]
    out = ("--out", place / "docs", "--cache", place / "cache")
    assert words in commands.refused(capsys, "reproduce", *args, *out)
    assert not list(place.iterdir())

"""suite reproduce: help for every experiment, and options that are refused."""

import pytest

from suite import cli
from suite.experiments import EXPERIMENTS
from tests.support.documents import reproduce


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_has_help_for_every_option(name, capsys):
    assert cli.main(["reproduce", name, "--help"]) == 0
    said = capsys.readouterr().out
    assert "--out" in said and "--json" in said and f"suite reproduce {name} [-h]" in said
    assert "--cache" in said.partition("advanced options")[2]


def test_pages_are_listed(capsys):
    assert cli.main(["reproduce"]) == 0
    listed = capsys.readouterr().out
    assert cli.main(["reproduce", "--help"]) == 0
    told = capsys.readouterr().out
    assert all(name in listed and name in told for name in EXPERIMENTS)


def test_lists_of_a_page_may_have_commas_or_spaces():
    line = "robustness --policy race race-paper --difficulty 0 3 --only wind,mass"
    config = cli.parse("reproduce", line.split())[1].experiment
    assert config.policy == ("race", "race-paper") and config.only == ("wind", "mass")
    assert config.difficulty == "0,3"


def test_an_experiment_that_does_not_exist_is_code_2(capsys):
    assert cli.main(["reproduce", "table3"]) == 2
    assert "table2" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("table2 --trials 0", "--trials is 0"),
        ("table2 --policy race-papr", "Did you mean 'race-paper'?"),
        ("table2 --policy nowhere/policy", "nowhere/policy: no such file"),
        ("table2 --vehicle referense", "Did you mean 'reference'?"),
        ("simulators --policy {folder}/mine.pt2", "suite reproduce never does"),
        (
            "simulators --simulator reference",
            "--simulator reference: the page compares with mujoco",
        ),
        ("simulators --simulator rotorpi", "Did you mean 'rotorpy'?"),
        ("simulators --simulator mjx --simulator mjx", "--simulator mjx is given twice"),
        ("robustness --only linear_darg", "Did you mean 'linear_drag'?"),
        (
            "robustness --policy race-paper --policy race-paper",
            "--policy race-paper is given twice",
        ),
        ("perception --only stero", "Did you mean 'stereo'?"),
        ("ablation --seed 0", "--seed 0 is one of --training-seeds"),
        ("ablation --training-seeds 1 1", "--training-seeds is 1 1"),
        ("ablation --only field@0.41", "Did you mean 'field 0.4'?"),
        ("ablation --set episode.batch=9", "this command sets episode.batch; give --worlds"),
        ("ablation --set episode.gates=6", "this command sets episode.gates; all fly 4"),
        ("ablation --set loss.projection=3", "this command sets loss.projection; it is compared"),
        ("ablation --set loss.field_gain=0", "loss.field_gain is 0, allowed is a number above"),
        ("ablation --seconds 0", "--seconds is 0"),
        ("ablation --recipe quik", "Did you mean 'quick'?"),
        ("ablation --iterations 0", "--iterations is 0"),
        ("robustness --workers 0", "--workers is '0'"),
        ("ablation --workers 99", "--workers is 99"),
        ("schemes --seed 0", "--seed 0 is one of --training-seeds"),
        ("schemes --only pop", "Did you mean 'ppo'?"),
        ("schemes --worlds 6", "allowed with PPO are multiples of its 4 minibatches"),
        ("schemes --measurements 0", "--measurements is 0"),
        ("schemes --set loss.progress=1.2", "this command sets loss.progress; give --progress"),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_done(
    line, words, sky, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("suite.train.run.train", None)
    program, place = tmp_path / "mine.pt2", tmp_path / "place"
    program.touch()
    place.mkdir()
    args = [word.replace("@", " ").format(folder=tmp_path) for word in line.split()]
    assert reproduce(place, *args) == 2
    said = capsys.readouterr().err
    assert words in said and len(said.strip().splitlines()) == 1
    assert not sky.flown and not list(place.iterdir())

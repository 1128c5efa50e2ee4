"""suite reproduce: help for every experiment, and what cannot be used."""

import pytest

from suite import cli
from suite.experiments import EXPERIMENTS
from tests.support.documents import reproduce


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_has_help_for_every_option(name, capsys):
    assert cli.main(["reproduce", name, "--help"]) == 0
    said = capsys.readouterr().out
    assert "--out" in said and "--cache" in said and "--json" in said


def test_an_experiment_that_does_not_exist_is_code_2(capsys):
    assert cli.main(["reproduce", "table3"]) == 2
    assert "table2" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["table2", "--trials", "0"], "--trials is 0"),
        (["table2", "--policy", "racr"], "Did you mean 'racer'?"),
        (["table2", "--delta-policy", "nowhere/policy"], "nowhere/policy: no such file"),
        (["table2", "--vehicle", "referense"], "Did you mean 'reference'?"),
        (["worlds", "--policy", "{folder}/mine.pt2"], "suite reproduce does of no policy"),
        (["robustness", "--only", "linear_darg"], "Did you mean 'linear_drag'?"),
        (["robustness", "--policy", "racer", "--policy", "racer"], "--policy racer is given twice"),
        (["seeds", "--policies", "racer", "racer"], "--policies racer is given twice"),
        (["seeds", "--preset", "smal"], "Did you mean 'small'?"),
        (["seeds", "--training-seeds", "1", "1"], "--training-seeds is 1 1"),
        (["seeds", "--policies", "racer", "--trials", "0"], "--trials is 0"),
        (["seeds", "--workers", "0"], "--workers is '0'"),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_flown(args, words, sky, tmp_path, capsys):
    program, place = tmp_path / "mine.pt2", tmp_path / "place"
    program.touch()
    place.mkdir()
    assert reproduce(place, *(arg.format(folder=tmp_path) for arg in args)) == 2
    said = capsys.readouterr().err
    assert words in said and len(said.strip().splitlines()) == 1
    assert not sky.flown and not list(place.iterdir())

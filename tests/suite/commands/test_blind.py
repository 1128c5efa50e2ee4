"""The blind command."""

import json

import pytest

from suite import cli
from suite.blind import make


def test_the_command_says_which_flights_separate(capsys):
    assert cli.main(["blind", "plan", "--effects", "linear_drag", "rotor_drag", "--json"]) == 0
    flights = json.loads(capsys.readouterr().out)["flights"]
    assert {flight["kind"] for flight in flights} == {"punches", "figure_eight"}
    assert cli.main(["blind", "plan"]) == 2
    assert cli.main(["blind", "score", "--out", "/no/such/set"]) == 2


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ("run --set published", "--set is published, but `suite blind run` does not take it, only"),
        ("score --seed 0", "--seed is 0, but `suite blind score` does not take it, only make;"),
        ("run --count 24", "--count is 24, but"),
        ("score --simulator rotorpy", "--simulator is rotorpy, but"),
        ("run --effects inflow gusts", "--effects is inflow gusts, but"),
        ("make --effects inflow", "does not take it, only plan; leave it out"),
        ("score --workers 2", "--workers is 2, but `suite blind score` does not take it, "),
        ("plan --effects inflow gusts --out elsewhere", "--out is elsewhere, but"),
    ],
)
def test_an_option_of_another_work_is_refused(args, words, tmp_path, monkeypatch, capsys):
    """Taken in silence it would be believed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(make, "make_set", None)
    assert cli.main(["blind", *args.split()]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert words in said and not list(tmp_path.iterdir())

"""The small commands: tracks, effects and blind."""

import json

import pytest

from suite import cli
from suite.blind import make


def test_tracks_command_lists_and_draws(tmp_path, capfd):
    assert cli.main(["tracks", "--json"]) == 0
    families = json.loads(capfd.readouterr().out)["families"]
    assert families["zigzag"]["judged"] and not families["random"]["judged"]
    args = ["tracks", "zigzag", "--difficulty", "0,9", "--seed", "4", "--out", str(tmp_path)]
    assert cli.main(args) == 0
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["zigzag-0-4.png", "zigzag-4.png", "zigzag-9-4.png"]
    assert (tmp_path / names[0]).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["tracks", "elipse"], "Did you mean 'ellipse'?"),
        (["tracks", "ellipse", "--difficulty", "12"], "level 12 is not 0 to 9"),
        (["effects", "linear_darg"], "Did you mean 'linear_drag'?"),
    ],
)
def test_wrong_names_are_code_2_and_one_line(args, words, capsys):
    assert cli.main(args) == 2
    said = capsys.readouterr().err
    assert words in said and len(said.strip().splitlines()) == 1


def test_effects_command_lists_and_describes(capfd):
    assert cli.main(["effects", "--json"]) == 0
    effects = json.loads(capfd.readouterr().out)["effects"]
    assert effects["linear_drag"]["parameters"]["coefficient"]["unit"] == "1/s"
    assert cli.main(["effects", "linear_drag"]) == 0
    assert "coefficient x 3 [1/s]" in capfd.readouterr().out


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

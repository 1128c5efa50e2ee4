"""The small commands: tracks and effects."""

import json

import pytest

from suite import cli


def test_tracks_command_lists_and_draws(tmp_path, capfd):
    assert cli.main(["tracks", "--json"]) == 0
    families = json.loads(capfd.readouterr().out)["families"]
    assert families["zigzag"]["judged"] and not families["random"]["judged"]
    args = ["tracks", "zigzag", "--difficulty", "0,9", "--seed", "4", "--out", str(tmp_path)]
    assert cli.main(args) == 0
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["zigzag-0-4.png", "zigzag-9-4.png"]
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

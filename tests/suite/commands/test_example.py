"""The command copies the shipped example, and the diagnosis names what is hidden in it."""

import json

import pytest

from suite import cli
from suite.diagnose.example.flights import FOLDER, HIDDEN

FILES = sorted(FOLDER.glob("*.parquet"))


def test_the_command_copies_all_a_diagnosis_needs(tmp_path, capsys):
    assert cli.main(["example", "--out", str(tmp_path / "x"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["files"] == sorted([*(p.name for p in FILES), "vehicle.toml"])
    for name in answer["files"]:
        assert (tmp_path / "x" / name).read_bytes() == (FOLDER / name).read_bytes()


@pytest.mark.slow
def test_the_diagnosis_names_it(tmp_path, capsys):
    assert cli.main(["example", "--out", str(tmp_path / "x")]) == 0
    line = [str(tmp_path / "x"), "--vehicle", str(tmp_path / "x" / "vehicle.toml")]
    capsys.readouterr()
    assert cli.main(["diagnose", *line, "--out", str(tmp_path / "out"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "named"
    (effect,) = found["effects"]
    assert effect["name"] == "com_offset" and effect["alternatives"] == []
    entry = effect["parameters"]["offset"]
    for truth, (low, high) in zip(HIDDEN["com_offset"].offset[:2], entry["ci95"][:2], strict=True):
        half = (high - low) / 2
        assert low - half <= truth <= high + half
    assert entry["value"][2] is None and found["gap"]["after"] < 1.15

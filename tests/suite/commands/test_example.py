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


def test_the_real_flights_come_as_published_with_licence_and_mapping(tmp_path, capsys):
    assert cli.main(["example", "--real", "--out", str(tmp_path), "--json"]) == 0
    names = json.loads(capsys.readouterr().out)["files"]
    logs = [name for name in names if name.endswith(".csv")]
    assert len(logs) == 2
    for name in logs:
        assert f"{name.removesuffix('.csv')}_metadata.yaml" in names
        rows = (tmp_path / name).read_text().splitlines()
        assert rows[0].startswith("t,px,py,pz,qx,qy,qz,qw,vx") and len(rows) == 1451
    assert "Redistributions in binary form" in (tmp_path / "LICENSE").read_text()
    assert "arXiv 2603.09908" in (tmp_path / "README.md").read_text()
    packed = sum(path.stat().st_size for path in (FOLDER / "real").iterdir() if path.is_file())
    assert packed < 320_000


def test_a_real_log_imports_at_the_first_try_and_tells_a_vehicle(tmp_path, capsys):
    assert cli.main(["example", "--real", "--out", str(tmp_path)]) == 0
    raw, log = tmp_path / "B3_figure8_fast_rep1.csv", tmp_path / "eight.parquet"
    line = ["--map", str(tmp_path / "nanobench.toml"), "--vehicle", "crazyflie21"]
    assert cli.main(["import", str(raw), *line, "--out", str(log)]) == 0
    line = ["--vehicle", "crazyflie21", "--out", str(tmp_path / "mine.toml"), "--json"]
    capsys.readouterr()
    assert cli.main(["identify", str(log), *line]) == 0
    found = json.loads(capsys.readouterr().out)
    drag = found["parameters"]["effects.linear_drag.coefficient"]["value"]
    assert 0.3 < drag[0] < 0.6 and 0.3 < drag[1] < 0.6
    assert any("a crazyflie loop are not fitted" in text for text in found["untold"])


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

"""Sets of cases: made, locked, resumed, and diagnosed."""

import json
import sys

import pytest

from eval.logs.flight_log import read_flight
from eval.quadrotor.vehicle_file import load_vehicle
from suite.blind import make as make_module
from suite.blind.build import build
from suite.blind.make import make_set, open_answers
from suite.blind.run import run_set
from suite.blind.score import report, score_set
from suite.common.console import Console
from tests.support.blind import NULL
from tests.support.commands import answer, refused
from tracks.common.files import write_json


def test_what_the_diagnosis_sees_says_nothing_of_the_answer_and_a_changed_answer_is_noticed(
    small_set,
):
    for name in ("case_001", "case_002"):
        folder = small_set / "cases" / name
        assert {p.name for p in folder.iterdir()} == {"vehicle.toml", "flight_1.parquet"}
        log = read_flight(folder / "flight_1.parquet")
        text = json.dumps(log.about) + (folder / "vehicle.toml").read_text()
        assert "single" not in text and "hidden" not in text
        assert log.about["seed"] is None
        assert not load_vehicle(folder / "vehicle.toml").effects or name == "case_002"
    manifest = (small_set / "manifest.json").read_text()
    assert "linear_drag" not in manifest and '"kind"' not in manifest
    path = small_set / "answers" / "case_001.json"
    path.write_text(path.read_text().replace("linear_drag", "rotor_drag"))
    with pytest.raises(ValueError, match="case_001"):
        open_answers(small_set)


def test_a_set_goes_on_where_it_stopped(small_set, monkeypatch):
    kept = (small_set / "cases" / "case_001" / "flight_1.parquet").read_bytes()
    manifest = json.loads((small_set / "manifest.json").read_text())
    gone = small_set / "answers" / "case_002.json"
    gone.unlink()
    built = []
    monkeypatch.setattr(make_module, "build", lambda case: built.append(case) or build(case))
    make_set(small_set, 5, None, Console())
    assert built == [NULL], "only what was missing"
    assert (small_set / "cases" / "case_001" / "flight_1.parquet").read_bytes() == kept
    again = json.loads((small_set / "manifest.json").read_text())
    assert again["answers"] == manifest["answers"]
    with pytest.raises(ValueError, match="another --out"):
        make_set(small_set, 6, None, Console())
    (small_set / "cases" / "case_001" / "vehicle.toml").write_text("")
    with pytest.raises(ValueError, match=r"vehicle\.toml: not the file that the manifest"):
        make_set(small_set, 5, None, Console())


def test_without_its_simulator_nothing_is_begun(tmp_path, monkeypatch, capsys):
    """A folder that says whose set it is would be refused for another's."""
    monkeypatch.setitem(sys.modules, "torchdiffeq", None)
    out = tmp_path / "out"
    said = refused(capsys, "blind make --simulator rotorpy --out", out)
    assert "pip install 'diffracing-suite[rotorpy]'" in said and not out.exists()
    with pytest.raises(ValueError, match="count = 0"):
        make_set(out, 5, 0, Console())
    assert not out.exists()


def test_a_diagnosis_runs_over_a_set_and_is_scored(small_set):
    seen = []

    def diagnose(flights, vehicle, out):
        seen.append(out.name)
        assert load_vehicle(vehicle).name in ("bare", "dragged") and len(flights) == 1
        if out.name == "case_002" and seen.count("case_002") == 1:
            raise RuntimeError("lost its way")
        named = {"name": "linear_drag", "alternatives": [], "parameters": {}}
        found = {"verdict": "no_gap", "effects": [], "gap": {}, "git_commit": f"c{len(seen)}"}
        if out.name == "case_001":
            found |= {"verdict": "named", "effects": [named]}
        write_json(out / "diagnosis.json", found)

    with pytest.raises(ValueError, match="no case was diagnosed yet; do that with"):
        score_set(small_set)
    assert run_set(small_set, diagnose, Console()) == 1
    failed = score_set(small_set)
    assert [v.verdict for v in failed] == ["named", "failed"]
    assert run_set(small_set, diagnose, Console()) == 2
    assert seen == ["case_001", "case_002", "case_002"], "what was done is not done again"
    verdicts = score_set(small_set)
    assert [v.verdict for v in verdicts] == ["named", "no_gap"]
    text = report(small_set, verdicts)
    assert "nulls: something named" in text
    assert "Diagnosed by 2 versions of the code: c1, c3." in text
    table = json.loads((small_set / "table.json").read_text())
    assert table["diagnosed_by"] == ["c1", "c3"]


def test_a_case_that_was_not_run_has_not_failed(small_set, capsys):
    def diagnose(flights, vehicle, out):
        if out.name == "case_002":
            raise KeyboardInterrupt
        write_json(out / "diagnosis.json", {"verdict": "no_gap", "effects": [], "gap": {}})

    with pytest.raises(KeyboardInterrupt):
        run_set(small_set, diagnose, Console())
    said = answer(capsys, "blind score --out", small_set)
    assert ([v["case"] for v in said["cases"]], said["not_run"]) == (["case_001"], ["case_002"])
    failed = next(s for s in said["shares"] if s["what"] == "diagnosis failed")
    assert (failed["count"], failed["of"]) == (0, 1)
    table = (small_set / "table.md").read_text()
    assert "Not run yet, so in none of these numbers: 1 of 2 cases." in table
    assert json.loads((small_set / "table.json").read_text())["not_run"] == ["case_002"]

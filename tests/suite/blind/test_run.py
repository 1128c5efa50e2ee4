"""A diagnosis over a set: failures are tried again, what is done is not."""

import json

import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from suite import cli
from suite.blind.run import run_set
from suite.blind.score import report, score_set
from suite.common.console import Console
from tracks.common.files import write_json


def test_a_diagnosis_runs_over_a_set_and_is_scored(small_set):
    seen = []

    def diagnose(flights, vehicle, out):
        seen.append(out.name)
        assert load_vehicle(vehicle).name in ("bare", "dragged") and len(flights) == 1
        if out.name == "case_002" and seen.count("case_002") == 1:
            raise RuntimeError("lost its way")
        named = {"name": "linear_drag", "alternatives": [], "parameters": {}}
        effects = [named] if out.name == "case_001" else []
        write_json(
            out / "diagnosis.json",
            {"verdict": "named" if effects else "no_gap", "effects": effects, "gap": {}},
        )

    with pytest.raises(ValueError, match="no case was diagnosed yet; do that with"):
        score_set(small_set)
    assert run_set(small_set, diagnose, Console()) == 1
    failed = score_set(small_set)
    assert [v.verdict for v in failed] == ["named", "failed"]
    assert run_set(small_set, diagnose, Console()) == 2
    assert seen == ["case_001", "case_002", "case_002"], "what was done is not done again"
    verdicts = score_set(small_set)
    assert [v.verdict for v in verdicts] == ["named", "no_gap"]
    assert "nulls: something named" in report(small_set, verdicts)


def test_a_case_that_was_not_run_has_not_failed(small_set, capsys):
    def diagnose(flights, vehicle, out):
        if out.name == "case_002":
            raise KeyboardInterrupt
        write_json(out / "diagnosis.json", {"verdict": "no_gap", "effects": [], "gap": {}})

    with pytest.raises(KeyboardInterrupt):
        run_set(small_set, diagnose, Console())
    assert cli.main(["blind", "score", "--out", str(small_set), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert ([v["case"] for v in said["cases"]], said["not_run"]) == (["case_001"], ["case_002"])
    failed = next(s for s in said["shares"] if s["what"] == "diagnosis failed")
    assert (failed["count"], failed["of"]) == (0, 1)
    table = (small_set / "table.md").read_text()
    assert "Not run yet, so in none of these numbers: 1 of 2 cases." in table
    assert json.loads((small_set / "table.json").read_text())["not_run"] == ["case_002"]

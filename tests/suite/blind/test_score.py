"""Sets of cases: made, locked, resumed, diagnosed; and the scorer on answers written by hand."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from eval.judging.statistics import wilson
from eval.logs.flight_log import read_flight
from eval.quadrotor.vehicle_file import load_vehicle
from suite.blind import make as make_module
from suite.blind.build import build
from suite.blind.make import make_set, open_answers
from suite.blind.run import run_set
from suite.blind.score import COVERED, _gap_ratios, report, score_case, score_set, shares
from suite.common.console import Console
from tests.support.blind import NULL
from tests.support.commands import answer, refused
from tracks.common.files import write_json


def test_what_is_diagnosed_says_nothing_of_the_answer_and_a_changed_answer_is_noticed(small_set):
    for name in ("case_001", "case_002"):
        folder = small_set / "cases" / name
        assert {p.name for p in folder.iterdir()} == {"vehicle.toml", "flight_1.parquet"}
        about = read_flight(folder / "flight_1.parquet").about
        text = json.dumps(about) + (folder / "vehicle.toml").read_text()
        assert "single" not in text and "hidden" not in text and about["seed"] is None
        assert not load_vehicle(folder / "vehicle.toml").effects or name == "case_002"
    manifest, path = small_set / "manifest.json", small_set / "answers" / "case_001.json"
    assert not any(word in manifest.read_text() for word in ("linear_drag", '"kind"'))
    path.write_text(path.read_text().replace("linear_drag", "rotor_drag"))
    with pytest.raises(ValueError, match="case_001"):
        open_answers(small_set)


def test_a_set_goes_on_where_it_stopped(small_set, monkeypatch):
    case, manifest = small_set / "cases" / "case_001", small_set / "manifest.json"
    kept, listed = (case / "flight_1.parquet").read_bytes(), json.loads(manifest.read_text())
    (small_set / "answers" / "case_002.json").unlink()
    built = []
    monkeypatch.setattr(make_module, "build", lambda case: built.append(case) or build(case))
    make_set(small_set, 5, None, Console())
    assert built == [NULL], "only what was missing"
    assert (case / "flight_1.parquet").read_bytes() == kept
    assert json.loads(manifest.read_text())["answers"] == listed["answers"]
    with pytest.raises(ValueError, match="another --out"):
        make_set(small_set, 6, None, Console())
    (case / "vehicle.toml").write_text("")
    with pytest.raises(ValueError, match=r"vehicle\.toml: not the file that the manifest"):
        make_set(small_set, 5, None, Console())


def test_a_case_that_is_made_again_loses_its_diagnosis(small_set):
    """Its flights may be others, if the code has changed; the set accepts them."""
    for name in ("case_001", "case_002"):
        write_json(small_set / "results" / name / "seconds.json", {"seconds": 1.0})
    (small_set / "answers" / "case_002.json").unlink()
    make_set(small_set, 5, None, Console())
    assert [path.name for path in (small_set / "results").iterdir()] == ["case_001"]


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
    assert [v.verdict for v in score_set(small_set)] == ["named", "failed"]
    assert run_set(small_set, diagnose, Console()) == 2
    assert seen == ["case_001", "case_002", "case_002"], "what was done is not done again"
    verdicts = score_set(small_set)
    assert [v.verdict for v in verdicts] == ["named", "no_gap"]
    text = report(small_set, verdicts)
    assert "nulls: something named" in text and "by 2 versions of the code: c1, c3." in text
    assert json.loads((small_set / "table.json").read_text())["diagnosed_by"] == ["c1", "c3"]


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


TRUTH = {
    "kind": "single",
    "effects": [
        {"name": "rotor_drag", "parameters": {"coefficient": 3e-5}, "multiple": 2.0,
         "required": ["linear_drag"], "allowed": ["linear_drag", "quadratic_drag"]}
    ],
}  # fmt: skip
NOTHING = {"kind": "null", "effects": []}
OUTSIDE = {"kind": "outside", "effects": [], "outside": {"name": "tether", "multiple": 6.0}}


def effect(name, *alternatives, **parameters):
    table = {key: {"value": 0.0, "ci95": span} for key, span in parameters.items()}
    return {"name": name, "alternatives": list(alternatives), "parameters": table}


def hidden(name, **parameters):
    """Return the truth of a case with an effect that no other looks like."""
    one = {"name": name, "parameters": parameters, "multiple": 2.0, "required": [], "allowed": []}
    return {"kind": "single", "effects": [one]}


def said(*effects, verdict="named", after=0.5, floor=0.5):
    gap = {"after": after, "noise_floor": floor}
    return {"verdict": verdict, "effects": list(effects), "gap": gap}


def score(truth, *effects):
    """Return the verdict on a diagnosis that names effects."""
    return score_case("c", truth, said(*effects), 1.0)


@pytest.mark.parametrize(
    ("effects", "found", "extra"),
    [
        ([effect("rotor_drag", "linear_drag")], True, 0),
        ([effect("linear_drag", "rotor_drag")], True, 0),
        ([effect("rotor_drag", "linear_drag", "quadratic_drag")], True, 0),
        ([effect("rotor_drag", "linear_drag", "constant_wind + quadratic_drag")], True, 0),
        ([effect("rotor_drag")], False, 0),
        ([effect("rotor_drag", "linear_drag", "inflow")], False, 0),
        ([effect("linear_drag")], False, 1),
        ([effect("rotor_drag", "linear_drag"), effect("inflow")], True, 1),
        ([effect("rotor_drag", "linear_drag"), effect("linear_drag", "rotor_drag")], True, 1),
        ([], False, 0),
    ],
)
def test_sets_are_held_to_what_the_data_can_tell(effects, found, extra):
    verdict = score(TRUTH, *effects)
    assert (verdict.found, verdict.extra) == (found, extra)
    assert verdict.exact == (found and not extra)


def test_two_effects_need_both():
    pair = {"kind": "pair", "effects": [*TRUTH["effects"], *hidden("mass_offset")["effects"]]}
    one, other = effect("rotor_drag", "linear_drag"), effect("mass_offset")
    assert score(pair, other, one).exact
    assert not score(pair, one).found


def test_intervals_count_by_component_and_leave_out_what_cannot_be_seen():
    truth = hidden("com_offset", offset=[0.001, 0.002, None])
    found = effect("com_offset", offset=[[0.0, 0.002], [0.003, 0.004], None])
    assert score(truth, found).covered == (True, False)
    other = effect("torque_trim", "com_offset", offset=[[0.0, 1.0]])
    assert score(truth, other).covered == ()
    # A weak motor is matched by its number.
    truth = hidden("weak_motor", scale=[1.0, 1.0, 0.9, 1.0])
    found = effect("weak_motor", scale=[0.88, 0.92])
    for number, covered in ((3, True), (2, False)):
        found["parameters"]["index"] = {"value": number}
        assert score(truth, found).covered == (covered,)


def test_the_share_of_intervals_has_an_interval_over_cases():
    """The components of one diagnosis depend on each other."""
    truth = hidden("com_offset", offset=[0.001, 0.002])
    right = effect("com_offset", offset=[[0.0, 0.01], [0.0, 0.01]])
    wrong = effect("com_offset", offset=[[0.0, 0.01], [0.003, 0.004]])
    found = [score_case("c", truth, said(one), 1.0) for one in (right, right, wrong, wrong)]
    (share,) = (s for s in shares(found) if s.what == COVERED)
    assert (share.count, share.of) == (6, 8)
    assert (share.low, share.high) == wilson(3, 4)[1:]


def counts(verdicts):
    return {share.what: (share.count, share.of) for share in shares(verdicts)}


def test_the_table_counts_what_is_named_and_a_diagnosis_that_failed_as_no_null(tmp_path):
    right = effect("rotor_drag", "linear_drag", coefficient=[1e-5, 5e-5])
    verdicts = [
        score_case("a", TRUTH, said(right, after=0.56), 3.0),
        score_case("b", NOTHING, said(verdict="no_gap"), 1.0),
        score_case("c", NOTHING, said(effect("inflow")), 2.0),
        score_case("d", OUTSIDE, said(verdict="unknown"), 2.0),
        score_case("e", OUTSIDE, None, None),
    ]
    lines = counts(verdicts)
    assert lines["single effects: named, nothing else"] == (1, 1)
    assert lines["nulls: something named"] == (1, 2)
    assert lines["outside the catalogue: `unknown` or `partly`"] == (1, 2)
    assert lines["95 % intervals that contain the true value"] == (1, 1)
    assert lines["gap after within 1.1 of the noise floor, where named"] == (0, 1)
    gusts = score_case("f", hidden("gusts"), said(effect("gusts"), after=5.0), 2.0)
    assert gusts.found and _gap_ratios([*verdicts, gusts]) == [1.12]
    assert lines["diagnosis failed"] == (1, 5)
    page = Path("docs/results/blind.md").read_text(encoding="utf-8").splitlines()
    rows = [[cell.strip() for cell in row.split("|")] for row in page[:40]]
    goals = {cells[1]: cells[-2] for cells in rows if len(cells) == 8}
    compared = [(s.wanted, goals[s.what]) for s in shares(verdicts) if s.what in goals]
    assert len(compared) == 5 and all(wanted == goal for wanted, goal in compared)
    half = next(s for s in shares(verdicts) if s.what == "nulls: something named")
    assert (half.low, half.high) == pytest.approx((0.0945, 0.9055), abs=1e-3)  # Wilson, 1 of 2
    write_json(tmp_path / "manifest.json", {"cases": {}, "answers": {}, "failed": {}})
    text = report(tmp_path, verdicts)
    assert "| c | null |" in text and "| a |" not in text
    assert json.loads((tmp_path / "table.json").read_text())["seconds_median"] == 2.0
    failed = [score_case(name, truth, None, None) for name, truth in (("f", NOTHING), ("g", TRUTH))]
    lines = counts([*verdicts[1:3], *failed])
    assert lines["nulls: something named"] == (1, 2)
    assert lines["nulls: verdict `no_gap`"] == (1, 3)
    assert lines["single effects: named, nothing else"] == (0, 1)
    assert "cases with a false extra name" not in lines, "nothing was named where it failed"
    assert lines["diagnosis failed"] == (2, 4)


def test_damping_by_moving_hubs_is_there_where_its_size_is_right():
    drag, hubs = effect("rotor_drag", "linear_drag"), np.array([0.0, 0.0, 0.05])

    def found(*size):
        damping = effect("angular_damping")
        damping["parameters"] = {"coefficient": {"value": list(size), "ci95": [None] * 3}}
        return score_case("c", TRUTH, said(drag, damping), 1.0, hubs)

    right = found(0.0, 0.0, 0.06)
    assert (right.exact, right.extra, right.brought) == (True, 0, 1)
    assert all(found(*size).extra == 1 for size in ((0, 0, 0.2), (0.06, 0, 0), (0.2, 0, 0.06)))
    assert score_case("c", TRUTH, said(drag), 1.0, hubs).exact

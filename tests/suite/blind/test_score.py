"""The scorer on answers and diagnoses written by hand."""

import json
from pathlib import Path

import numpy as np
import pytest

from suite.blind.score import _gap_ratios, report, score_case, shares
from tracks.common.files import write_json

TRUTH = {
    "kind": "single",
    "effects": [
        {"name": "rotor_drag", "parameters": {"coefficient": 3e-5}, "multiple": 2.0,
         "required": ["linear_drag"], "allowed": ["linear_drag", "quadratic_drag"]}
    ],
}  # fmt: skip
NULL = {"kind": "null", "effects": []}
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


def test_the_table_counts_what_is_named_and_a_diagnosis_that_failed_as_no_null(tmp_path):
    right = effect("rotor_drag", "linear_drag", coefficient=[1e-5, 5e-5])
    verdicts = [
        score_case("a", TRUTH, said(right, after=0.56), 3.0),
        score_case("b", NULL, said(verdict="no_gap"), 1.0),
        score_case("c", NULL, said(effect("inflow")), 2.0),
        score_case("d", OUTSIDE, said(verdict="unknown"), 2.0),
        score_case("e", OUTSIDE, None, None),
    ]
    lines = {s.what: (s.count, s.of) for s in shares(verdicts)}
    assert lines["single effects: named, nothing else"] == (1, 1)
    assert lines["nulls: something named"] == (1, 2)
    assert lines["outside the catalogue: `unknown` or `partly`"] == (1, 2)
    assert lines["95 % intervals that contain the true value"] == (1, 1)
    assert lines["gap after within 1.1 of the noise floor, where named"] == (0, 1)
    gusts = score_case("f", hidden("gusts"), said(effect("gusts"), after=5.0), 2.0)
    assert gusts.found and _gap_ratios([*verdicts, gusts]) == [1.12]
    assert lines["diagnosis failed"] == (1, 5)
    page = Path("docs/results/blind.md").read_text(encoding="utf-8").splitlines()
    goals = {
        cells[1].strip(): cells[-2].strip()
        for cells in (row.split("|") for row in page[:40])
        if len(cells) == 8
    }
    compared = [(s.wanted, goals[s.what]) for s in shares(verdicts) if s.what in goals]
    assert len(compared) == 5 and all(wanted == goal for wanted, goal in compared)
    half = next(s for s in shares(verdicts) if s.what == "nulls: something named")
    assert (half.low, half.high) == pytest.approx((0.0945, 0.9055), abs=1e-3)  # Wilson, 1 of 2
    write_json(tmp_path / "manifest.json", {"cases": {}, "answers": {}, "failed": {}})
    text = report(tmp_path, verdicts)
    assert "| c | null |" in text and "| a |" not in text
    assert json.loads((tmp_path / "table.json").read_text())["seconds_median"] == 2.0
    verdicts = [
        score_case("a", NULL, said(verdict="no_gap"), 1.0),
        score_case("b", NULL, said(effect("inflow")), 1.0),
        score_case("c", NULL, None, None),
        score_case("d", TRUTH, None, None),
    ]
    lines = {s.what: (s.count, s.of) for s in shares(verdicts)}
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

"""Sets of cases: drawn, made, locked, resumed, diagnosed."""

import json
from collections import Counter

import numpy as np
import pytest

from eval.effects import EFFECTS
from eval.logs.flight_log import read_flight
from eval.quadrotor.vehicle_file import load_vehicle
from suite import cli
from suite.blind import build as build_module
from suite.blind import make as make_module
from suite.blind.build import build
from suite.blind.cases import SETS, Case, draw_cases, draw_rotorpy_cases
from suite.blind.hidden import changed_values, draw_change
from suite.blind.make import make_set, open_answers
from suite.blind.oracle.strength import columns_in_table, detectable_along, given_vehicle
from suite.blind.run import run_set
from suite.blind.score import report, score_set
from suite.common.console import Console
from suite.diagnose.plans.trajectory import Trajectory
from tracks.common.files import write_json

SINGLE = Case("single", ("linear_drag",), 6.0, "bare", "estimator", (5, 1))
NULL = Case("null", (), 0.0, "dragged", "capture", (5, 2))


@pytest.fixture(autouse=True)
def short_flights(monkeypatch):
    """Every ordinary flight is one short figure eight."""

    def flights(rng):
        return [Trajectory("figure_eight", 2.0, speed=float(rng.uniform(3, 5)), size=2.0)]

    monkeypatch.setattr(build_module, "ordinary_flights", flights)


@pytest.fixture
def small_set(tmp_path, monkeypatch):
    monkeypatch.setattr(
        make_module, "draw_cases", lambda seed, count: {"case_001": SINGLE, "case_002": NULL}
    )
    make_set(tmp_path, 5, None, Console())
    return tmp_path


def test_a_full_set_has_the_numbers_that_were_promised():
    cases = draw_cases(SETS["published"])
    kinds = Counter(case.kind for case in cases.values())
    assert kinds == {
        "single": 2 * len(EFFECTS),
        "null": 100,
        "outside": 40,
        "pair": 20,
        "blurred": 15,
        "separated": 15,
    }
    singles = {(c.hidden[0], c.multiple) for c in cases.values() if c.kind == "single"}
    assert singles == {(name, m) for name in EFFECTS for m in (2.0, 6.0)}
    outside = {case.hidden[0] for case in cases.values() if case.kind == "outside"}
    assert len(outside) >= 6
    blurred = sorted((c.seed, c.hidden) for c in cases.values() if c.kind == "blurred")
    apart = sorted((c.seed, c.hidden) for c in cases.values() if c.kind == "separated")
    assert blurred == apart, "the same pairs with the same truth"


def test_sets_repeat_by_seed_and_do_not_share_cases():
    tuning, published = draw_cases(SETS["tuning"]), draw_cases(SETS["published"])
    assert tuning == draw_cases(SETS["tuning"])
    assert not {c.seed for c in tuning.values()} & {c.seed for c in published.values()}
    few = Counter(case.kind for case in draw_cases(1, 12).values())
    assert len(few) == 6 and sum(few.values()) < 20
    with pytest.raises(ValueError, match="count"):
        draw_cases(1, 0)
    assert {case.simulator for case in draw_rotorpy_cases(1).values()} == {"rotorpy"}


def test_a_strength_is_the_multiple_of_the_table_or_cut_at_a_bound():
    nominal = given_vehicle("bare")
    for name in EFFECTS:
        vehicle = nominal if name not in ("constant_wind", "gusts") else given_vehicle("dragged")
        rng = np.random.default_rng(3)
        change, multiple = draw_change(rng, vehicle, "full", name, 2.0)
        values = changed_values(vehicle, "full", name, change, rng)
        assert multiple <= 2.0 and np.abs(change).max() > 0.0, name
        direction = change / np.linalg.norm(change)
        unit = detectable_along(vehicle.name, "full", name, direction)
        assert np.linalg.norm(change) / unit == pytest.approx(multiple, rel=1e-6), name
        assert len(columns_in_table(vehicle.name, "full", name)) == len(change)
        assert isinstance(values, EFFECTS[name].values)


def test_a_case_is_the_same_to_the_bit_and_its_seed_matters():
    first, again = build(SINGLE), build(SINGLE)
    np.testing.assert_array_equal(first.logs[0].pos_w, again.logs[0].pos_w)
    assert first.answer == again.answer
    other = build(Case("single", ("linear_drag",), 6.0, "bare", "estimator", (6, 1)))
    assert other.answer["effects"][0]["parameters"] != first.answer["effects"][0]["parameters"]


def test_what_is_hidden_is_in_the_logs_and_not_in_the_vehicle_file():
    built = build(SINGLE)
    assert "linear_drag" not in built.nominal.effects
    coefficient = np.array(built.answer["effects"][0]["parameters"]["coefficient"])
    flight = built.recordings[0]
    vel_b = np.einsum("tij,ti->tj", flight.motion.rot_w, flight.motion.vel_w)
    # The accelerometer of a vehicle without other aerodynamics shows the drag alone across.
    across = flight.acc_b[1:, :2]
    np.testing.assert_allclose(across, -coefficient[:2] * vel_b[:-1, :2], rtol=1e-6, atol=1e-9)
    assert built.answer["effects"][0]["sigma"] > 0.0


def test_outside_cases_say_how_much_the_catalogue_cannot_explain():
    built = build(Case("outside", ("ripple",), 6.0, "bare", "capture", (5, 3)))
    outside = built.answer["outside"]
    assert built.answer["verdict"] == "unknown" and not built.truth.effects
    assert outside["multiple"] == pytest.approx(6.0, rel=0.25) or outside["strength"] == 0.3


def test_what_the_diagnosis_sees_says_nothing_of_the_answer(small_set):
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


def test_a_changed_answer_or_log_is_noticed(small_set):
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

    assert run_set(small_set, diagnose, Console()) == 1
    failed = score_set(small_set)
    assert [v.verdict for v in failed] == ["named", "failed"]
    assert run_set(small_set, diagnose, Console()) == 2
    assert seen == ["case_001", "case_002", "case_002"], "what was done is not done again"
    verdicts = score_set(small_set)
    assert [v.verdict for v in verdicts] == ["named", "no_gap"]
    assert "nulls: something named" in report(small_set, verdicts)


def test_the_command_says_which_flights_separate(capsys):
    assert cli.main(["blind", "plan", "--effects", "linear_drag", "rotor_drag", "--json"]) == 0
    flights = json.loads(capsys.readouterr().out)["flights"]
    assert {flight["kind"] for flight in flights} == {"punches", "figure_eight"}
    assert cli.main(["blind", "plan"]) == 2
    assert cli.main(["blind", "score", "--out", "/no/such/set"]) == 2

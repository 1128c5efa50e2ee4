"""Flights that tell a set apart: written, read back, and diagnosed with the old ones."""

import json

import numpy as np
import pytest

from eval.effects import EFFECTS
from eval.flights.simulate import SENSORS, fly, log_of
from eval.flights.trajectory import Trajectory
from suite.diagnose.diagnose import diagnose
from suite.diagnose.plan import (
    COLUMNS,
    OTHERWISE,
    SEPARATIONS,
    advice,
    plan_for,
    separations_of,
    trajectories_for,
    write_plan,
)
from suite.diagnose.report.diagnosis_json import diagnosis_json
from tests.support.vehicles import PLAIN, with_effects, with_lag

LAGGED = with_lag(PLAIN, 0.03)
SET = {"effects": [{"name": "rotor_drag", "alternatives": ["linear_drag"]}]}


def test_the_plan_is_for_the_sets_alone_and_comes_back_from_its_file(tmp_path):
    ways, words = trajectories_for(SET)
    entry = next(e for e in SEPARATIONS if set(e.pair) == {"rotor_drag", "linear_drag"})
    assert {way.kind for way in ways} == {way.kind for way in entry.separating}
    assert len(ways) == 2 * len(entry.separating) and entry.words in words[0]
    alone = {"effects": [{"name": "rotor_drag", "alternatives": []}]}
    assert trajectories_for(alone) == ([], [])
    assert write_plan(tmp_path / "plan", [], [])["flights"] == []
    assert not (tmp_path / "plan").exists()
    ways = [Trajectory("punches", 3.0, speed=2.0), Trajectory("hover", 2.0, turn="sweep")]
    plan = write_plan(tmp_path / "plan", ways, ["fly them"])
    written = json.loads((tmp_path / "plan" / "plan.json").read_text())
    assert [Trajectory(**flight["trajectory"]) for flight in written["flights"]] == ways
    table = np.loadtxt(tmp_path / "plan" / plan["flights"][0]["file"], delimiter=",", skiprows=1)
    assert table.shape == (301, len(COLUMNS))
    wanted = ways[0].reference(table[:, 0])
    np.testing.assert_allclose(table[:, 1:4], wanted.pos_w, atol=1e-5)
    np.testing.assert_allclose(table[:, 4:7], wanted.vel_w, atol=1e-4)
    assert plan["flights"][0]["top_speed"] == pytest.approx(
        np.linalg.norm(wanted.vel_w, axis=1).max()
    )


def test_an_earlier_plan_goes_and_what_is_not_of_it_stays(tmp_path):
    folder = tmp_path / "plan"
    plan = write_plan(folder, [Trajectory("hover", 3.0), Trajectory("punches", 3.0)], [])
    own = folder / "my_own.parquet"
    own.write_bytes(b"a real flight")
    outside = tmp_path / "outside.csv"
    outside.write_text("not the plan's to remove")
    listed = json.loads((folder / "plan.json").read_text())
    listed["flights"][0]["file"] = "../outside.csv"
    (folder / "plan.json").write_text(json.dumps(listed))
    write_plan(folder, [], [])
    assert not (folder / "plan.json").exists()
    assert not (folder / plan["flights"][1]["file"]).exists()
    assert own.exists() and outside.exists()
    (folder / "plan.json").write_text("[]")
    assert write_plan(folder, *trajectories_for(SET))["flights"]


@pytest.mark.slow
def test_flying_the_plan_turns_the_set_into_a_name():
    truth = with_effects(LAGGED, rotor_drag=(3e-5,))
    entry = next(e for e in SEPARATIONS if set(e.pair) == {"rotor_drag", "linear_drag"})
    rng = np.random.default_rng(5)

    def flown(ways):
        sensors, recordings = SENSORS["estimator"], fly(LAGGED, truth, ways)
        return [log_of(one, truth, sensors, rng, str(k)) for k, one in enumerate(recordings)]

    logs = flown([*entry.blurred, *entry.blurred])
    found = diagnosis_json(diagnose(logs, LAGGED))
    (effect,) = found["effects"]
    assert {effect["name"], *effect["alternatives"]} >= {"rotor_drag", "linear_drag"}
    ways, _ = trajectories_for(found)
    (effect,) = diagnosis_json(diagnose([*logs, *flown(ways)], LAGGED))["effects"]
    assert (effect["name"], effect["alternatives"]) == ("rotor_drag", [])
    low, high = effect["parameters"]["coefficient"]["ci95"]
    assert low < 3e-5 < high


def test_plans_name_catalogue_effects_and_end_in_flights():
    for entry in SEPARATIONS:
        assert set(entry.pair) <= set(EFFECTS) and entry.pair[0] != entry.pair[1]
        assert entry.separating and entry.blurred and entry.words
    assert separations_of(["rotor_drag", "linear_drag"])[0].pair == ("linear_drag", "rotor_drag")
    (wind,) = separations_of(["frame_tilt", "constant_wind + linear_drag"])
    assert wind.pair == ("constant_wind", "frame_tilt") and "two headings" in wind.words
    assert plan_for(["gusts", "inflow"]), "an unknown pair gets the flights that excite most"
    assert advice("linear_drag", "rotor_drag").startswith("linear_drag from rotor_drag: ")
    assert OTHERWISE not in advice("linear_drag", "rotor_drag")
    assert OTHERWISE in advice("inflow", "gyro_bias")

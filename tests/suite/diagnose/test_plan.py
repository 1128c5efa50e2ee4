"""Flights that tell a set apart: written, read back, flown, and diagnosed with the old ones."""

import json
from dataclasses import replace

import numpy as np
import pytest

from eval.effects import EFFECTS
from eval.flights.simulate import SENSORS, fly, log_of
from eval.flights.trajectory import Trajectory
from eval.logs.flight_log import read_flight
from suite.diagnose.diagnose import diagnose
from suite.diagnose.plan import (
    COLUMNS,
    OTHERWISE,
    SEPARATIONS,
    advice,
    fly_plan,
    plan_for,
    separations_of,
    trajectories_for,
    write_plan,
    write_plan_of,
)
from suite.diagnose.report.diagnosis_json import diagnosis_json
from tests.support.vehicles import PLAIN, with_effects, with_lag

LAGGED = with_lag(PLAIN, 0.03)
SET = {"effects": [{"name": "rotor_drag", "alternatives": ["linear_drag"]}]}


SIGMA = np.repeat([0.002, 0.004, np.nan, 0.02, np.nan, np.nan], [3, 3, 3, 3, 3, 4])
"""Noise of position, attitude and rates; nothing else was logged."""


def test_a_plan_comes_back_from_its_file(tmp_path):
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


def test_the_plan_is_for_the_sets_and_only_for_them(tmp_path):
    ways, words = trajectories_for(SET)
    entry = next(e for e in SEPARATIONS if set(e.pair) == {"rotor_drag", "linear_drag"})
    assert {way.kind for way in ways} == {way.kind for way in entry.separating}
    assert len(ways) == 2 * len(entry.separating) and entry.words in words[0]
    alone = {"effects": [{"name": "rotor_drag", "alternatives": []}]}
    assert trajectories_for(alone) == ([], [])
    assert write_plan_of(alone, tmp_path / "plan")["flights"] == []
    assert not (tmp_path / "plan").exists()


def test_an_earlier_plan_goes_and_what_is_not_of_it_stays(tmp_path):
    folder = tmp_path / "plan"
    plan = write_plan(folder, [Trajectory("hover", 3.0), Trajectory("punches", 3.0)], [])
    flown = fly_plan(plan, SIGMA, LAGGED, LAGGED, folder, 3)
    own = folder / "flights" / "my_own.parquet"
    own.write_bytes(b"a real flight")
    outside = tmp_path / "outside.csv"
    outside.write_text("not the plan's to remove")
    listed = json.loads((folder / "plan.json").read_text())
    listed["flights"][0]["file"] = "../outside.csv"
    (folder / "plan.json").write_text(json.dumps(listed))
    write_plan_of({"effects": []}, folder)
    assert not (folder / "plan.json").exists()
    assert not any((folder / flight["flown"]).exists() for flight in flown["flights"])
    assert own.exists() and outside.exists()
    (folder / "plan.json").write_text("[]")
    assert write_plan_of(SET, folder)["flights"]


def test_a_plan_is_flown_with_the_noise_of_the_logs(tmp_path):
    plan = write_plan(tmp_path / "plan", [Trajectory("hover", 3.0), Trajectory("low", 2.0)], [])
    wild = dict(plan["flights"][1])
    wild["trajectory"] = {**wild["trajectory"], "kind": "circle", "speed": 60.0, "duration_s": 4.0}
    plan["flights"].append(wild)
    flown = fly_plan(plan, SIGMA, LAGGED, LAGGED, tmp_path / "plan", 3)
    names = [flight["flown"] for flight in flown["flights"]]
    assert names[0] and names[1] and names[2] is None
    assert len(flown["warnings"]) == 1 and "could not be flown" in flown["warnings"][0]
    log = read_flight(tmp_path / "plan" / names[0])
    assert log.velocity_derived and log.rotor_speed is None
    assert (log.integrator, log.step_s) == ("euler", 1.0 / LAGGED.controller.frequency)
    still = log.time_s > 1.5
    assert 0.001 < np.std(log.pos_w[still, 2]) < 0.003
    assert json.loads((tmp_path / "plan" / "plan.json").read_text())["flights"][0]["flown"]


@pytest.mark.slow
def test_flying_the_plan_turns_the_set_into_a_name(tmp_path):
    truth = with_effects(LAGGED, rotor_drag=(3e-5,))
    entry = next(e for e in SEPARATIONS if set(e.pair) == {"rotor_drag", "linear_drag"})
    ways = [*entry.blurred, *entry.blurred]
    rng = np.random.default_rng(5)
    logs = [
        log_of(recording, truth, SENSORS["estimator"], rng, f"old_{k}")
        for k, recording in enumerate(fly(LAGGED, truth, ways))
    ]
    first = diagnose(logs, LAGGED)
    found = diagnosis_json(first)
    (effect,) = found["effects"]
    assert {effect["name"], *effect["alternatives"]} >= {"rotor_drag", "linear_drag"}
    plan = write_plan_of(found, tmp_path / "plan")
    plan = fly_plan(plan, first.sigma, LAGGED, truth, tmp_path / "plan", 1)
    new = [read_flight(tmp_path / "plan" / flight["flown"]) for flight in plan["flights"]]
    again = diagnosis_json(diagnose([*logs, *(replace(log, about={}) for log in new)], LAGGED))
    (effect,) = again["effects"]
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

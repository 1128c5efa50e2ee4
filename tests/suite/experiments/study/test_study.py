"""The study by hand: what is trained and flown in which order; effects alone, and sweeps."""

import json
import math
from importlib.metadata import EntryPoint, EntryPoints

import numpy as np
import pytest

from eval.effects import EFFECTS
from eval.effects.interface import bound_value
from eval.quadrotor.vehicle_file import load_vehicle, shipped_vehicles
from eval.sensors.sensors_file import PERFECT, sensor_set
from eval.worlds.trial import TrialSpec
from suite.common.console import Console
from suite.experiments.study import cache, disturbed
from suite.experiments.study.cache import Workspace, added_digest, code_digest, digest
from suite.experiments.study.conditions import (
    Condition,
    effect_conditions,
    sweep_conditions,
    sweeps,
)
from suite.experiments.study.judging import Setup, TrialRequest, fly_trials
from suite.experiments.study.training import Setting, Study, UnseenWorlds, read_measurements
from suite.train.recipes import named_recipe
from tests.support.vehicles import with_effects
from tracks.common import names as registry

VEHICLE = load_vehicle("reference")
RECIPE = named_recipe("race-paper")


def test_rows_take_turns_where_they_are_to_meet_the_same_load():
    rows, unseen = [Setting("a", "", RECIPE), Setting("b", "", RECIPE)], UnseenWorlds(0, 3, 9, 1.0)
    study = Study(rows, (4, 5), unseen)
    assert [(key, c.seed) for key, c in study.pieces()] == [("a", 4), ("a", 5), ("b", 4), ("b", 5)]
    turns = Study(rows, (4, 5), unseen, by_seed=True)
    assert [(key, c.seed) for key, c in turns.pieces()] == [("a", 4), ("b", 4), ("a", 5), ("b", 5)]


def test_the_same_setup_in_two_orders_flies_a_trial_once(sky, tmp_path):
    one, two = TrialSpec("zigzag", 0, 1), TrialSpec("zigzag", 0, 2)
    setup = Setup("race-paper", VEHICLE)
    orders = {"a": TrialRequest(setup, [one, two]), "b": TrialRequest(setup, [two])}
    found = fly_trials(orders, Workspace(tmp_path, tmp_path), Console(), "flying")
    assert len(sky.flown) == 2 and found["b"] == found["a"][1:]
    assert [row.trial for row in found["a"]] == [one, two]


def test_policies_fly_the_same_trials_under_every_condition(sky, tmp_path):
    trials = [TrialSpec("zigzag", 0, seed) for seed in (1, 2, 3)]
    alone, grown = disturbed.select_conditions(VEHICLE, ("wind", "mass_offset"))
    assert [c.name for c in alone] == ["mass_offset"] * 2
    (wind,) = grown
    base, policies = Condition("undisturbed", 0.0, "", VEHICLE), {"p": "race-paper", "r": "race"}
    (tested,), points = disturbed.fly_conditions(
        [base], {wind: grown[wind][:2]}, policies, trials, Workspace(tmp_path, tmp_path), Console()
    )
    assert [row.trial for row in tested.results["p"]] == trials
    assert len(points[wind]) == 2 and len(sky.flown) == 2 * 2 * 3, "the undisturbed once"
    numbers = disturbed.tested_numbers(points[wind][1], tested)["policies"]["r"]
    assert numbers["success"].value == 0 and math.isclose(numbers["change"].value, 0)


def test_time_leaves_compilation_out(tmp_path):
    seconds = [(0, 30.0, True), (1, 2.0, False), (2, 11.0, True), (3, 3.0, False), (4, 4.0, False)]
    rows = [{"iteration": k, "seconds": s, "cold": cold} for k, s, cold in seconds]
    watched = [{"iteration": k, "gates": float(k)} for k in (0, 3, 5)]
    for name, lines in (("metrics.jsonl", rows), ("validation.jsonl", watched)):
        (tmp_path / name).write_text("".join(json.dumps(line) + "\n" for line in lines))
    points, compiling = read_measurements(tmp_path, 10)
    assert [(p["steps"], p["time"], p["gates"]) for p in points] == [
        (0, 0.0, 0.0), (30, 3 + 2 + 3, 3.0), (50, 3 + 2 + 3 + 3 + 4, 5.0),
    ]  # fmt: skip
    assert compiling == 27 + 8


def test_the_cache_is_named_by_all_code_that_flies(tmp_path, monkeypatch):
    for room, name in (("eval", "judge.py"), ("eval", "view/video.py"), ("suite", "cli.py")):
        path = tmp_path / room / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("a = 1")
    monkeypatch.setattr(cache, "ROOT", tmp_path)
    code_digest.cache_clear()

    def now():
        code_digest.cache_clear()
        return code_digest("eval")

    first = now()
    (tmp_path / "suite" / "cli.py").write_text("a = 2")
    (tmp_path / "eval" / "view" / "video.py").write_text("a = 2")
    assert now() == first, "neither flies"
    (tmp_path / "eval" / "judge.py").write_text('"""Words."""\na = (1)  # one')
    assert now() == first, "the statements are the same"
    (tmp_path / "eval" / "judge.py").write_text("a = 2")
    second = now()
    (tmp_path / "eval" / "judge.py").rename(tmp_path / "eval" / "jury.py")
    assert len({first, second, now()}) == 3
    code_digest.cache_clear()
    assert digest({"a": 1}) != digest({"a": 2}) and len(digest(load_vehicle("reference"))) == 16


def test_the_cache_is_named_by_what_other_packages_add(tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "_installed", lambda: EntryPoints([]))
    assert added_digest() is None
    monkeypatch.syspath_prepend(tmp_path)
    single, package = tmp_path / "extra_drag.py", tmp_path / "extra_tracks" / "spiral.py"
    package.parent.mkdir()
    for path in (single, package, package.with_name("__init__.py")):
        path.write_text("FORCE = 1")
    entries = EntryPoints(
        [
            EntryPoint("drag", "extra_drag:FORCE", "diffracing_suite.effects"),
            EntryPoint("spiral", "extra_tracks.spiral:FORCE", "diffracing_suite.tracks"),
            EntryPoint("gone", "extra_gone:FORCE", "diffracing_suite.tracks"),
            EntryPoint("other", "extra_other:FORCE", "another_program.effects"),
        ]
    )
    monkeypatch.setattr(registry, "_installed", lambda: entries)
    found = [added_digest()]
    for path in (single, package):
        path.write_text("FORCE = 2")
        found.append(added_digest())
    assert None not in found and len(set(found)) == 3
    assert [entry.name for entry in registry.added_entries()] == ["drag", "gone", "spiral"]


def test_every_effect_that_touches_a_flight_is_flown_at_its_usual_size():
    conditions = effect_conditions(VEHICLE)
    flown = {condition.name for condition in conditions}
    assert set(EFFECTS) - flown == {"gyro_bias", "accelerometer_bias", "clock_offset"}
    for condition in conditions:
        assert condition.vehicle.effects[condition.name] is not None
        others = {k: v for k, v in condition.vehicle.effects.items() if k != condition.name}
        own = {k: v for k, v in VEHICLE.effects.items() if k != condition.name}
        assert others == own and condition.sensors == PERFECT
    by_words = {(c.name, c.size_text): c.vehicle.effects[c.name] for c in conditions}
    # The vehicle has drag of its own; what is more of the two stays, axis by axis.
    assert by_words["linear_drag", "coefficient (0.5, 0.5, 0.72) 1/s"].coefficient[2] == 0.72
    assert by_words["motor_lag", "time_constant 0.06 s"].time_constant == 0.06
    assert by_words["command_delay", "delay 0.04 s"].delay == 0.04
    assert by_words["thrust_scale", "scale 0.85"].scale == pytest.approx(0.85)
    assert by_words["thrust_scale", "scale 1.15"].scale == pytest.approx(1.15)
    assert by_words["weak_motor", "scale (0.85, 1, 1, 1)"].scale[0] == pytest.approx(0.85)
    assert np.linalg.norm(by_words["constant_wind", "velocity (-3, 4, 0) m/s"].velocity) == 5
    assert np.linalg.norm(
        by_words["com_offset", "offset (0.006, 0.008, 0) m"].offset
    ) == pytest.approx(0.01)


def test_sweeps_begin_at_the_vehicle_as_it_is_and_grow():
    for sweep in sweeps(VEHICLE):
        first, *rest = sweep_conditions(VEHICLE, sweep)
        assert first.vehicle is VEHICLE and first.sensors == PERFECT and len(rest) >= 4
        assert list(sweep.sizes) == sorted(set(sweep.sizes))
        seen = [(repr(c.vehicle), repr(c.sensors)) for c in (first, *rest)]
        assert len(set(seen)) == len(seen), sweep.name
    named = {sweep.name: sweep for sweep in sweeps(VEHICLE)}
    assert named["motor lag"].sizes[0] == pytest.approx(30)
    assert named["latency"].sizes[0] == pytest.approx(30)
    heavy, _ = named["mass"].make(VEHICLE, 40)
    assert heavy.effects["mass_offset"].offset == pytest.approx(0.3)
    drag, _ = named["drag"].make(VEHICLE, 4)
    assert drag.effects["linear_drag"].coefficient == pytest.approx((0.72, 0.72, 2.88))
    assert drag.effects["quadratic_drag"].coefficient == pytest.approx((0.04, 0.04, 0.16))
    late, _ = named["latency"].make(VEHICLE, 80)
    assert late.effects["command_delay"].delay == pytest.approx(0.08)
    _, sensors = named["jittering age of both"].make(VEHICLE, 40)
    assert sensors == sensor_set({"delay": {"state": 0.04, "image": 0.04, "jitter": 1.0}})
    _, sensors = named["age of both"].make(VEHICLE, 60)
    assert sensors == sensor_set({"delay": {"state": 0.06, "image": 0.06}})
    _, sensors = named["state-estimation noise"].make(VEHICLE, 2)
    values = sensors.models["state_noise"]
    assert (values.position, values.velocity) == pytest.approx((0.06, 0.2))
    assert values.attitude == pytest.approx(np.radians(2)) and values.correlation == 0.5


def test_sweeps_of_a_vehicle_with_effects_begin_at_those():
    own = with_effects(VEHICLE, mass_offset=(0.15,), constant_wind=((3.0, -4.0, 0.0),))
    named = {sweep.name: sweep for sweep in sweeps(own)}
    assert named["mass"].sizes == (pytest.approx(20), 40, 60)
    assert named["wind"].sizes == (5.0, 6, 8)
    heavy = sweep_conditions(own, named["mass"])[1].vehicle
    assert heavy.effects["mass_offset"].offset == pytest.approx(0.3)
    (slow,) = (s for s in sweeps(with_effects(VEHICLE, motor_lag=(0.2,))) if s.name == "motor lag")
    assert slow.sizes == pytest.approx((200, 300, 400)), "past the last size it still grows"


def test_what_a_vehicle_says_of_an_effect_besides_its_size_stays():
    given = {"gusts": (3.0, 9.0), "slung_load": (0.05, 2.0), "ground_effect": (1.0, 0.09)}
    own = with_effects(VEHICLE, **given)
    flown = {c.name: c.vehicle.effects[c.name] for c in effect_conditions(own)}
    assert flown["gusts"] == (3.0, 9.0)
    assert flown["slung_load"] == (0.1, 2.0) and flown["ground_effect"] == (8.0, 0.09)


@pytest.mark.parametrize("name", shipped_vehicles())
def test_no_effect_is_beyond_what_a_vehicle_may_have(name):
    """The usual sizes are those of 0.5 to 1 kg; 27 g less 0.2 kg would be no vehicle at all."""
    vehicle = load_vehicle(name)
    for condition in effect_conditions(vehicle):
        parameter = EFFECTS[condition.name].parameters[0]
        value = np.array(getattr(condition.vehicle.effects[condition.name], parameter.name))
        assert (value >= bound_value(parameter.low, vehicle)).all(), condition.size_text
        assert (value <= bound_value(parameter.high, vehicle)).all(), condition.size_text


def test_all_drag_of_a_vehicle_grows_and_where_there_is_none_it_comes_anew():
    rotors = with_effects(VEHICLE, linear_drag=((0.2, 0.2, 0.7),), rotor_drag=(1e-5,))
    named = {sweep.name: sweep for sweep in sweeps(rotors)}
    more, _ = named["drag"].make(rotors, 4)
    assert more.effects["rotor_drag"].coefficient == pytest.approx(4e-5)
    assert more.effects["linear_drag"].coefficient == pytest.approx((0.8, 0.8, 2.8))
    assert "quadratic_drag" not in more.effects
    bare = load_vehicle("crazyflie21")
    (sweep,) = (sweep for sweep in sweeps(bare) if sweep.name == "drag")
    drags = [c.vehicle.effects.get("linear_drag") for c in sweep_conditions(bare, sweep)]
    assert drags == [None, *(((size,) * 3,) for size in (0.5, 1, 2, 4))]
    assert sweep.axis == "linear drag, each axis [1/s]"

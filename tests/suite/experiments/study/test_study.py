"""The study by hand: what is trained and flown in which order, kept under which name, summed up."""

import json
import math
from importlib.metadata import EntryPoint, EntryPoints

from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import TrialSpec
from suite.common.console import Console
from suite.experiments.study import cache, disturbed
from suite.experiments.study.cache import Place, added_digest, code_digest, digest
from suite.experiments.study.conditions import Condition
from suite.experiments.study.judging import Order, Setup, flown
from suite.experiments.study.training import Row, Study, Unseen, curve_of
from suite.train.recipes import named_recipe
from tracks.common import names as registry

VEHICLE = load_vehicle("reference")
RECIPE = named_recipe("race-paper")


def test_rows_take_turns_where_they_are_to_meet_the_same_load():
    rows, unseen = [Row("a", "", RECIPE), Row("b", "", RECIPE)], Unseen(0, 3, 9, 1.0)
    study = Study(rows, (4, 5), unseen)
    assert [(key, c.seed) for key, c in study.pieces()] == [("a", 4), ("a", 5), ("b", 4), ("b", 5)]
    turns = Study(rows, (4, 5), unseen, by_seed=True)
    assert [(key, c.seed) for key, c in turns.pieces()] == [("a", 4), ("b", 4), ("a", 5), ("b", 5)]


def test_the_same_setup_in_two_orders_flies_a_trial_once(sky, tmp_path):
    one, two = TrialSpec("zigzag", 0, 1), TrialSpec("zigzag", 0, 2)
    setup = Setup("race-paper", VEHICLE)
    orders = {"a": Order(setup, [one, two]), "b": Order(setup, [two])}
    found = flown(orders, Place(tmp_path, tmp_path), Console(), "flying")
    assert len(sky.flown) == 2 and found["b"] == found["a"][1:]
    assert [row.trial for row in found["a"]] == [one, two]


def test_policies_fly_the_same_trials_under_every_condition(sky, tmp_path):
    trials = [TrialSpec("zigzag", 0, seed) for seed in (1, 2, 3)]
    alone, grown = disturbed.chosen_conditions(VEHICLE, ("wind", "mass_offset"))
    assert [c.name for c in alone] == ["mass_offset"] * 2
    (wind,) = grown
    base, policies = Condition("undisturbed", 0.0, "", VEHICLE), {"p": "race-paper", "r": "race"}
    (tested,), points = disturbed.flown_under(
        [base], {wind: grown[wind][:2]}, policies, trials, Place(tmp_path, tmp_path), Console()
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
    points, compiling = curve_of(tmp_path, 10)
    assert [(p["steps"], p["time"], p["gates"]) for p in points] == [
        (0, 0.0, 0.0), (30, 3 + 2 + 3, 3.0), (50, 3 + 2 + 3 + 3 + 4, 5.0),
    ]  # fmt: skip
    assert compiling == 27 + 8


def test_the_cache_is_named_by_all_code_that_flies(tmp_path, monkeypatch):
    for room, name in (("eval", "judge.py"), ("eval", "view/video.py"), ("suite", "cli.py")):
        path = tmp_path / room / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("one")
    monkeypatch.setattr(cache, "ROOT", tmp_path)
    code_digest.cache_clear()

    def now():
        code_digest.cache_clear()
        return code_digest("eval")

    first = now()
    (tmp_path / "suite" / "cli.py").write_text("two")
    (tmp_path / "eval" / "view" / "video.py").write_text("two")
    assert now() == first, "neither flies"
    (tmp_path / "eval" / "judge.py").write_text("two")
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

"""The study by hand: what is trained in which order, summed up over seeds, and flown once."""

import math

from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import TrialSpec
from suite.common.console import Console
from suite.experiments.study import disturbed
from suite.experiments.study.conditions import Condition
from suite.experiments.study.judging import Flier, Order, flown
from suite.experiments.study.training import Row, Study
from suite.train.presets import preset

VEHICLE = load_vehicle("reference")
RECIPE = preset("racer")


def test_rows_take_turns_where_they_are_to_meet_the_same_load():
    study = Study([Row("a", "", RECIPE), Row("b", "", RECIPE)], (4, 5))
    assert [(key, c.seed) for key, c in study.pieces()] == [("a", 4), ("a", 5), ("b", 4), ("b", 5)]
    turns = Study(study.rows, study.seeds, by_seed=True)
    assert [(key, c.seed) for key, c in turns.pieces()] == [("a", 4), ("b", 4), ("a", 5), ("b", 5)]


def test_the_same_flier_in_two_orders_flies_a_trial_once(sky, tmp_path):
    one, two = TrialSpec("zigzag", 0, 1), TrialSpec("zigzag", 0, 2)
    flier = Flier("racer", VEHICLE)
    orders = {"a": Order(flier, [one, two]), "b": Order(flier, [two])}
    found = flown(orders, tmp_path, Console(), "flying")
    assert len(sky.flown) == 2 and found["b"] == found["a"][1:]
    assert [row.trial for row in found["a"]] == [one, two]


def test_several_policies_under_one_name_fly_one_after_the_other(sky, tmp_path):
    trials = [TrialSpec("zigzag", 0, seed) for seed in (1, 2, 3)]
    alone, grown = disturbed.asked_conditions(VEHICLE, ("wind", "mass_offset"))
    assert [c.name for c in alone] == ["mass_offset"] * 2
    (wind,) = grown
    base = Condition("undisturbed", 0.0, "", VEHICLE)
    fliers = {"both": [("racer", trials[:1]), ("swift", trials[1:])]}
    (tested,), points = disturbed.flown_under(
        [base], {wind: grown[wind][:2]}, fliers, tmp_path, Console()
    )
    assert [row.trial for row in tested.results["both"]] == trials
    assert len(points[wind]) == 2 and len(sky.flown) == 2 * 3, "the undisturbed once for both"
    numbers = disturbed.tested_numbers(points[wind][1], tested)["policies"]["both"]
    assert numbers["success"].value == 0 and math.isclose(numbers["change"].value, 0)

"""What each spread is worth, from wins made up: in pairs, and a trial is one draw."""

import numpy as np
import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from suite.experiments.pages.randomisation import (
    ALL,
    FIXED,
    MEANING,
    OWN,
    RANDOMISED,
    UNDISTURBED,
    lead,
    seeds_grid,
    success_grid,
    worth_grid,
    worth_of,
)
from suite.experiments.study import disturbed
from suite.experiments.study.conditions import Condition
from tests.support.loops import trial_result

VEHICLE = load_vehicle("reference")
HALF = np.tile([True] * 5 + [False] * 5, 3)
"""Of thirty trials, ten of each training seed."""
SIZES = [10, 10, 10]


def under(name, **won):
    """Return a condition; what is not given loses all."""
    names = (FIXED, "without wind", RANDOMISED)
    won = {setting: won.get(setting.replace(" ", "_"), np.zeros(30, bool)) for setting in names}
    rows = {n: [trial_result(k, bool(w)) for k, w in enumerate(each)] for n, each in won.items()}
    return disturbed.Tested(Condition(name, 1.0, "1 m/s", VEHICLE), rows)


def worth(*entries):
    return worth_of(under("undisturbed"), entries, SIZES)


def test_a_trials_conditions_are_one_draw():
    windy = under("wind", randomised=HALF)
    once, often = (worth(*[windy] * count)[FIXED][ALL] for count in (1, 5))
    assert once.gap == often.gap and once.rates == often.rates
    assert often.gap.difference.value == 0.5 and often.gap.of_seeds == [0.5] * 3
    assert often.gap.difference.low == pytest.approx(0.33, abs=0.06)
    assert often.rates[1].value == 0.5 and often.rates[0].value == 0


def test_a_spread_has_a_disturbance_of_its_own_and_all_together_have_none():
    found = worth(under("wind", randomised=HALF), under("drag", without_wind=HALF))
    mine = found["without wind"]
    assert mine[OWN].gap.difference.value == 0.5 and mine[OWN].gap.verdict == "gain"
    assert mine[ALL].gap.difference.value == 0.0 and mine[UNDISTURBED].gap.verdict == "unclear"
    assert OWN not in found[FIXED] and found[FIXED][ALL].gap.difference.value == 0.25
    said = lead(found)
    assert said.startswith("Over all disturbances 25 % succeed where dynamics were randomised")
    assert "What pays under its own disturbance: wind +50 [" in said
    assert "What pays over all disturbances: nothing for certain." in said and "costs" not in said
    lines = [[cell.text for cell in row] for row in worth_grid(found).rows]
    assert [line[0] for line in lines] == ["wind", "all of them"]
    assert lines[0][-2:] == ["gain", ""] and lines[1][3] == "-"
    assert lines[0][3].endswith("(+50 +50 +50)")


def test_a_seed_that_does_not_agree_is_no_gain():
    torn = np.repeat([True, True, False], 10)
    assert worth(under("wind", randomised=torn))[FIXED][ALL].gap.verdict == "unclear"
    agreed = torn | (np.arange(30) > 24)
    assert worth(under("wind", randomised=agreed))[FIXED][ALL].gap.verdict == "gain"
    # Of two seeds nothing is called a gain, which a reader is told.
    pair = worth_of(under("undisturbed"), [under("wind", randomised=agreed)], [15, 15])
    assert pair[FIXED][ALL].gap.difference.low > 0 and pair[FIXED][ALL].gap.verdict == "unclear"
    assert "with less than 3 seeds nothing is called one" in MEANING[1]
    worse = worth(under("wind", without_wind=HALF))
    assert "What costs under its own disturbance: wind -50 [" in lead(worse)


def test_tables_have_every_setting_under_every_condition_and_by_seed():
    still = under("undisturbed", randomised=HALF)
    windy = under("wind", randomised=np.arange(30) < 3)
    rows = [[cell.text for cell in row] for row in success_grid([still, windy]).rows]
    assert rows == [["undisturbed 1 m/s", "0", "0", "50"], ["wind 1 m/s", "0", "0", "10"]]
    shares = {7: range(10), 8: range(10), 9: range(10)}
    by_seed = [[cell.text for cell in row] for row in seeds_grid(shares, still, [windy]).rows]
    assert by_seed[-1] == [RANDOMISED, "50, 30", "50, 0", "50, 0"]

"""What randomisation gains: the recipe, without each of its spreads, and without any, in pairs."""

import numpy as np
import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from suite.experiments.randomisation import (
    ALL,
    FIXED,
    OWN,
    RANDOMISED,
    UNDISTURBED,
    success_grid,
    worth_grid,
    worth_of,
)
from suite.experiments.study import disturbed
from suite.experiments.study.conditions import Condition
from tests.support.documents import page, reproduce
from tests.support.loops import trial_result

ARGS = ["randomisation", "--only", "thrust_scale", "--trials", "2", "--difficulty", "0"]


@pytest.mark.slow
def test_all_settings_of_every_seed_fly_the_same_share(sky, made, tmp_path):
    args = [*ARGS, *"--training-seeds 3 5 --iterations 7 --without thrust thrust".split()]
    assert reproduce(tmp_path, *args) == 0
    drawn = [(c.seed, c.quadrotor.thrust_spread, c.quadrotor.mass_std) for c in made]
    assert drawn == [
        (3, 0, 0), (5, 0, 0), (3, 0, 0.08), (5, 0, 0.08), (3, 0.1, 0.08), (5, 0.1, 0.08),
    ]  # fmt: skip
    assert {c.optimizer.iterations for c in made} == {7}
    # Undisturbed, less and more thrust; three tracks, two seeds, three settings.
    assert len(sky.flown) == (1 + 2) * 3 * 2 * 3
    text, numbers = page(tmp_path, "randomisation")
    assert list(numbers["worth"]) == ["fixed", "without thrust"]
    assert list(numbers["worth"]["without thrust"]) == [
        "undisturbed",
        "its own",
        "all disturbances",
    ]
    assert "- recipe: race init-from race-paper, 7 gradient steps" in text
    assert "| thrust | thrust_scale | +0 [+0, +0] (+0 +0) | +0" in text
    assert reproduce(tmp_path, *args) == 0
    assert len(made) == 6 and len(sky.flown) == 54, "the second time all is there"
    assert reproduce(tmp_path, *args, "--init-from", "race") == 0
    assert len(made) == 12, "from another policy all is trained anew"


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
    assert found[FIXED][ALL].rates[1].value == 0.25
    lines = [[cell.text for cell in row] for row in worth_grid(found).rows]
    assert [line[0] for line in lines] == ["wind", "all of them"]
    assert lines[0][-2:] == ["gain", ""] and lines[1][3] == "-"
    assert lines[0][3].endswith("(+50 +50 +50)")


def test_a_seed_that_does_not_agree_is_no_gain():
    torn = np.repeat([True, True, False], 10)
    assert worth(under("wind", randomised=torn))[FIXED][ALL].gap.verdict == "unclear"
    agreed = torn | (np.arange(30) > 24)
    assert worth(under("wind", randomised=agreed))[FIXED][ALL].gap.verdict == "gain"
    # Of two seeds nothing is called a gain.
    pair = worth_of(under("undisturbed"), [under("wind", randomised=agreed)], [15, 15])
    assert pair[FIXED][ALL].gap.difference.low > 0 and pair[FIXED][ALL].gap.verdict == "unclear"
    worse = worth(under("wind", without_wind=HALF))["without wind"][OWN]
    assert worse.gap.difference.value == -0.5 and worse.gap.verdict == "loss"


def test_a_table_has_every_setting_under_every_condition():
    still = under("undisturbed", randomised=HALF)
    windy = under("wind", randomised=np.arange(30) < 3)
    rows = [[cell.text for cell in row] for row in success_grid([still, windy]).rows]
    assert rows == [["undisturbed 1 m/s", "0", "0", "50"], ["wind 1 m/s", "0", "0", "10"]]

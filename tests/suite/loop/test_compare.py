"""Policies on the same trials, compared pair by pair."""

import numpy as np
import pytest

from eval.judging.statistics import bootstrap_mean
from suite.loop.compare import CellComparison, compare, policy_results
from suite.loop.hidden_effect import LABELS
from suite.loop.tables import cell_grid, comparison_grids, overall_grid, verdict
from tests.support.judged_cells import result


def _result(seed, success, v_mean, level=0):
    return result(seed, success, "p", level)._replace(v_max=v_mean + 1, v_mean=v_mean)


def test_differences_are_of_the_same_trials_and_none_is_called_none():
    n = 40
    speed = np.linspace(2, 6, n)
    won = {"before": 10, "without": 20, "with": 30}
    results = {
        name: [_result(k, k < count, speed[k] + 0.5 * (name == "with"), k % 2) for k in range(n)]
        for name, count in won.items()
    }
    lines = compare(results)
    cells = [(line.track, line.difficulty, line.trials) for line in lines]
    assert cells == [("zigzag", 0, 20), ("zigzag", 1, 20), ("all", None, 40)]
    overall = lines[-1]
    assert [m.value for m in overall.success] == pytest.approx([0.25, 0.5, 0.75, 0.25, 0.5])
    # 10 pairs, all one way: 2 / 2^10 by hand.
    assert overall.p_value == pytest.approx(2 / 2**10)
    assert overall.gates.with_minus_without.value == pytest.approx(5 * 0.25)
    # Every trial is 0.5 m/s faster: no spread in pairs, whatever the spread between trials.
    assert tuple(overall.v_mean.with_minus_without) == pytest.approx((0.5, 0.5, 0.5))
    assert tuple(overall.v_max.with_minus_before) == pytest.approx((0.5, 0.5, 0.5))
    assert overall.v_mean.before.high - overall.v_mean.before.low > 0.5
    success = comparison_grids(lines)[0]
    assert [cell.text for cell in success.rows[-1]][:4] == ["all", "all", "40", "25 [14, 40]"]
    assert success.rows[-1][6].tone == "good" and success.rows[-1][6].text.startswith("+25 [+")
    assert "75 % of 40 trials succeed: more than" in verdict(overall)
    with pytest.raises(ValueError, match="same trials"):
        compare({**results, "with": results["with"][::-1]})
    rows = [_result(k, k < 5, 3.0) for k in range(10)]
    lines: list[CellComparison] = compare({"before": rows, "without": rows, "with": rows})
    assert "not significantly different from" in verdict(lines[-1])
    cell = comparison_grids(lines)[0].rows[-1][6]
    assert cell.tone == "" and cell.text.startswith("+0 [")
    speed = comparison_grids(lines)[2].rows[-1][6]
    assert speed.text == "+0.00 [+0.00, +0.00]"


def test_bootstrap_of_a_mean_is_that_of_the_central_limit():
    values = np.random.default_rng(3).exponential(2.0, 400)
    found = bootstrap_mean(values)
    half = 1.96 * values.std() / np.sqrt(len(values))
    assert found.value == pytest.approx(values.mean())
    assert found.high - found.value == pytest.approx(half, rel=0.1)
    assert found.value - found.low == pytest.approx(half, rel=0.1)
    assert np.isnan(bootstrap_mean(np.array([]))).all()


def test_standings_are_paired_by_trial():
    won = {"nominal": 39, "before": 10, "control": 12, "delta": 20, "named": 36, "both": 40}
    results = {
        name: [result(k, k < count, "p", k % 2) for k in range(40)] for name, count in won.items()
    }
    stand = policy_results(results, ("before", "control", "nominal"))
    named = stand[4]
    assert named.success.value == pytest.approx(0.9) and named.gates.value == pytest.approx(7.5)
    assert [d.against for d in named.differences] == ["before", "control", "nominal"]
    assert named.differences[0].success.value == pytest.approx(26 / 40)
    # 26 pairs, all one way: 2 / 2^26 by hand.
    assert named.differences[0].p_value == pytest.approx(2 / 2**26)
    assert named.by_cell["zigzag 0"].value == pytest.approx(18 / 20)
    assert [d.against for d in stand[1].differences] == ["control", "nominal"]
    grid = overall_grid(stand, ("before", "control", "nominal"), LABELS, 40)
    assert {len(row) for row in grid.rows} == {len(grid.headers)}
    assert grid.rows[4][2].tone == "good" and grid.rows[1][2].text == ""
    cells = cell_grid(stand, LABELS)
    assert len(cells.rows) == 2 and cells.rows[0][5].text.startswith("90 [")
    with pytest.raises(ValueError, match="same trials"):
        policy_results({**results, "both": results["both"][::-1]}, ("before",))

"""Policies on the same trials, compared pair by pair."""

import numpy as np
import pytest

from eval.judging.statistics import bootstrap_mean
from suite.loop import delta_action
from suite.loop.compare import policy_results
from suite.loop.hidden_effect import LABELS
from suite.loop.tables import cell_grid, overall_grid
from tests.support.judged_cells import result


def test_differences_are_of_the_same_trials_and_none_is_called_none():
    won = {"before": 10, "without": 20, "with": 30}
    results = {
        name: [result(k, k < count, "p", k % 2) for k in range(40)] for name, count in won.items()
    }
    policies = policy_results(results, delta_action.REFERENCES)
    assert [one.success.value for one in policies] == pytest.approx([0.25, 0.5, 0.75])
    said = "75 % of 40 trials succeed: more than the same fine-tuning without it (50 %; difference"
    assert said in delta_action.verdict(policies, 40)
    equal = policy_results(dict.fromkeys(won, results["before"]), delta_action.REFERENCES)
    assert "not significantly different from" in delta_action.verdict(equal, 40)
    cell = overall_grid(equal, delta_action.REFERENCES, delta_action.LABELS, 40).rows[2][4]
    assert cell.tone == "" and cell.text.startswith("+0 [")


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

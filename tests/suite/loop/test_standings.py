"""Any number of policies on the same trials, each against its references."""

import pytest

from suite.loop.hidden_effect import LABELS
from suite.loop.standings import cell_grid, overall_grid, standings
from tests.support.loops import trial_result


def test_standings_are_paired_by_trial():
    won = {"nominal": 39, "before": 10, "control": 12, "delta": 20, "named": 36, "both": 40}
    results = {
        name: [trial_result(k, k < count, k % 2) for k in range(40)] for name, count in won.items()
    }
    stand = standings(results, ("before", "control", "nominal"))
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
        standings({**results, "both": results["both"][::-1]}, ("before",))

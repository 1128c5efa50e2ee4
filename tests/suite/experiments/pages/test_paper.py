"""What the paper prints, as printed."""

import pytest

from suite.experiments.pages.paper import ablation, sim_to_sim


def test_the_papers_table_is_as_printed():
    table = sim_to_sim()
    assert len(table.cells) == 3 * 3 * 4
    won = {(c.method, c.track, c.level): c.won for c in table.cells}
    fast = {(c.method, c.track, c.level): c.v_max for c in table.cells}
    assert [won["without_delta", "zigzag", level] for level in table.levels] == [10, 10, 8, 2]
    assert [won["with_delta", "ellipse", level] for level in table.levels] == [10, 10, 9, 7]
    assert [won["baseline", "zigzag", level] for level in table.levels] == [10, 10, 10, 6]
    assert (fast["with_delta", "circular", 0], fast["baseline", "ellipse", 9]) == (6.4, 5.2)
    assert sum(won.values()) == 320 and sum(fast.values()) == pytest.approx(209.6)


def test_the_papers_rows_are_as_printed():
    source, rows = ablation()
    assert "with and without AVF" in source and len(rows) == 8
    assert [row.success_cross for row in rows.values()] == [0.95, 0, 0, 0, 0.28, 0, 0, 0.58]
    assert sum(row.success_rate for row in rows.values()) == pytest.approx(6.25)
    assert sum(row.v_max for row in rows.values()) == pytest.approx(51.6)

"""Cells, pairings and how they are written, on trials whose numbers are given."""

import math

import pytest

from eval.judging.tables import HEADERS, NOTE, grids, markdown_table, summarise
from tests.support.judged_cells import ROWS, result


def test_paired_differences_are_on_the_same_trials():
    other = [result(seed, policy="theirs", speed=4.0) for seed in (3, 2, 1)]
    summary = summarise([*ROWS, *other, result(0, difficulty=9, policy="theirs")])
    assert [cell.policy for cell in summary["cells"]] == ["ours", "theirs", "theirs"]
    (pair,) = summary["paired"]
    assert (pair.policy, pair.against, pair.trials) == ("theirs", "ours", 3)
    assert pair.success.value == pytest.approx(1 / 3) and pair.p_value == 1.0
    assert pair.v_mean == (-1.0, -1.0, -1.0)
    assert "theirs - ours" in markdown_table(summary)


def test_a_cell_without_a_finished_trial():
    summary = summarise([result(0, False)])
    assert math.isnan(summary["cells"][0].lap_s.value)
    assert "collision 1" in markdown_table(summary)


def test_cells_do_not_depend_on_what_else_is_in_the_table():
    alone = summarise(ROWS)["cells"][0]
    beside = summarise([result(5, difficulty=1), *ROWS])["cells"][1]
    assert alone == beside


def test_late_answers_are_counted_beside_the_endings():
    rows = [
        *ROWS,
        *(result(seed, False)._replace(ended_by="timeout", late_actions=1) for seed in (7, 8)),
    ]
    (cell,) = summarise(rows)["cells"]
    assert cell.late == 2 and cell.ended_by["timeout"] >= 2
    ended = grids({"cells": [cell], "paired": []})[0].rows[0][-1].text
    assert ended.endswith(f"timeout {cell.ended_by['timeout']}, of these 2 by a late answer")


def test_one_table_for_the_cells_and_one_for_the_pairs():
    (cells,) = grids(summarise(ROWS))
    assert (cells.headers, cells.note) == (HEADERS, NOTE)
    assert cells.rows[0][4].text == "75 % [30, 95]"
    both = grids(summarise([*ROWS, result(3, policy="theirs")]))
    assert [grid.headers[0] for grid in both] == ["policy", "difference"]

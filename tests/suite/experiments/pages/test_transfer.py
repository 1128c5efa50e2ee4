"""Whose a failure is, by where else the same trial fails."""

import pytest

from eval.worlds.trial import TrialSpec
from suite.experiments.pages.transfer import SOURCES, Row, by_source, lead, overall

TRIAL = TrialSpec("circular", 3, 0)


@pytest.mark.parametrize(
    ("point", "quadrotor", "judge", "source"),
    [
        (True, True, True, None),
        (False, False, True, None),
        (True, True, False, "simulator"),
        (False, True, False, "simulator"),
        (True, False, False, "dynamics"),
        (False, False, False, "policy"),
    ],
)
def test_whose_a_failure_is(point, quadrotor, judge, source):
    assert Row(TRIAL, point, quadrotor, judge).source == source
    assert source is None or source in SOURCES


def test_failures_are_counted_by_track():
    rows = {"p": [Row(TRIAL, True, False, False)] * 3 + [Row(TRIAL, False, False, False)]}
    assert [[cell.text for cell in line] for line in by_source(rows).rows] == [
        ["p", "zigzag", "0", "0", "0", "0"],
        ["p", "circular", "4", "1", "3", "0"],
        ["p", "ellipse", "0", "0", "0", "0"],
    ]
    assert "p succeeds in 75.0 % of the trials in the trainer's point mass" in lead(rows)
    assert overall(rows).rows[0][2].text.startswith("75 %")

"""What the paper prints, and what is asked of a cell and missed, by numbers worked by hand."""

import pytest

from suite.experiments.pages.goals import goals
from tests.support.judged_cells import cell


def test_goals_by_hand():
    cells = [
        cell("zigzag", 0, 0.96, 7.3, low=0.902),  # others 10/10: the interval reaches down to 90 %
        cell("circular", 3, 0.93, 5.0, low=0.863),
        cell("zigzag", 9, 0.62, 6.1, low=0.52),  # others 7/10 at best: the rate itself
        cell("zigzag", 5, 0.1),  # no one printed a level 5
    ]
    zero, three, nine = goals(cells)
    assert (zero.success_miss, zero.v_max_miss) == (0, 0)
    assert zero.floor_miss == pytest.approx(0.03) and not zero.met
    assert three.success_miss == pytest.approx(0.037) and three.floor_miss == pytest.approx(0.05)
    assert (three.v_max, three.v_max_miss) == (6.2, pytest.approx(1.2))
    assert nine.success == 0.7 and nine.success_miss == pytest.approx(0.08)
    assert nine.v_max_miss == 0 and nine.floor_miss == pytest.approx(0.33)
    (perfect,) = goals([cell("ellipse", 6, 1.0, 6.4, low=0.963)])
    assert perfect.met


def test_a_printed_v_max_may_be_the_largest_of_ten():
    cells = [cell("ellipse", 6, 1.0, 6.2)._replace(v_max_of_ten=ten) for ten in (6.3, 6.2)]
    assert [goal.of_ten_miss for goal in goals(cells)] == [0, pytest.approx(0.1)]
    assert goals([cell("ellipse", 6, 1.0, 6.2)])[0].of_ten_miss is None, "too few trials"

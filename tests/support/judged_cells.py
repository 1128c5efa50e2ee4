"""A cell of a table, with the numbers that documents look at."""

from eval.judging.statistics import Interval
from eval.judging.tables import Tally


def cell(track, level, success, v_max=5.0, low=None):
    speed = Interval(v_max, v_max, v_max)
    rate = Interval(success, success if low is None else low, 1.0)
    return Tally("p", track, level, 100, rate, 8.0, speed, speed, speed, {})

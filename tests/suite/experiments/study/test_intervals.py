"""Intervals over training seeds and trials: as wide as seeds differ."""

import numpy as np
import pytest

from suite.experiments.study.intervals import crossed, nested


def test_intervals_are_as_wide_as_seeds_differ():
    steady, torn = np.full((4, 400), 0.0), np.zeros((4, 400))
    steady[:, ::2] = torn[::2] = 1.0
    for interval in (crossed, lambda gap: nested(list(gap))):
        one, other = interval(steady).difference, interval(torn).difference
        assert one.value == other.value == 0.5
        assert other.low <= 0.01 and other.high >= 0.99
    # Half of 400 trials in every seed. Where seeds share their trials: +- 2 sqrt(0.25 / 400);
    # where each has its own, 1,600 in all, half as much.
    widths = [each.high - each.low for each, _ in (crossed(steady), nested(list(steady)))]
    assert widths == pytest.approx([4 * np.sqrt(0.25 / 400), 4 * np.sqrt(0.25 / 1600)], rel=0.1)


def test_seeds_with_more_trials_weigh_more():
    assert nested([np.ones(30), np.zeros(10)]).difference.value == 0.75

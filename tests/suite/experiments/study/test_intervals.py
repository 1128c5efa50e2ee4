"""Intervals over training seeds and trials: as wide as seeds differ."""

import numpy as np
import pytest

from suite.experiments.study.intervals import nested


def test_intervals_are_as_wide_as_seeds_differ():
    steady, torn = np.full((4, 400), 0.0), np.zeros((4, 400))
    steady[:, ::2] = torn[::2] = 1.0
    one, other = nested(list(steady)).difference, nested(list(torn)).difference
    assert one.value == other.value == 0.5
    assert other.low <= 0.01 and other.high >= 0.99
    # Half of 1,600 trials in all, whatever the seed.
    assert one.high - one.low == pytest.approx(4 * np.sqrt(0.25 / 1600), rel=0.1)


def test_seeds_with_more_trials_weigh_more():
    assert nested([np.ones(30), np.zeros(10)]).difference.value == 0.75

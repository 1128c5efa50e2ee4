"""Intervals against published numbers and against their own promise."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eval.judging.statistics import (
    CONFIDENCE,
    bootstrap,
    expected_largest,
    mcnemar_exact,
    paired_success,
    wilson,
)


@given(st.integers(1, 200), st.data())
def test_wilson_is_where_the_score_test_rejects(trials, data):
    successes = data.draw(st.integers(0, trials))
    rate, low, high = wilson(successes, trials)
    assert 0 <= low <= rate <= high <= 1
    for end in (low, high):
        if 0 < end < 1:
            assert abs(rate - end) == pytest.approx(1.959964 * (end * (1 - end) / trials) ** 0.5)


@pytest.mark.parametrize(("successes", "trials"), [(1, 0), (-1, 5), (6, 5)])
def test_wilson_refuses(successes, trials):
    with pytest.raises(ValueError, match="successes"):
        wilson(successes, trials)


def pairs(both, only_first, only_second, neither):
    first = [True] * (both + only_first) + [False] * (only_second + neither)
    second = [True] * both + [False] * only_first + [True] * only_second + [False] * neither
    return np.array(first), np.array(second)


@pytest.mark.parametrize(
    ("table", "value", "low", "high"),
    # Newcombe 1998, Statistics in Medicine 17, 2635-2650, method 10; the second is the worked
    # example of Altman et al. 2000, Statistics with Confidence, Table 6.2.
    [((36, 12, 2, 0), 0.2, 0.0569, 0.3404), ((14, 5, 0, 22), 0.122, 0.011, 0.226)],
)
def test_paired_success_published(table, value, low, high):
    found = paired_success(*pairs(*table))
    assert found[:3] == pytest.approx((value, low, high), abs=6e-4)
    first, second = pairs(*table)
    turned = paired_success(second, first)
    assert turned[:3] == pytest.approx((-found.value, -found.high, -found.low))
    none = paired_success(*pairs(10, 0, 0, 0))
    assert none.value == 0 and none.low < 0 < none.high and none.p_value == 1


@pytest.mark.parametrize(
    ("b", "c", "p"), [(0, 5, 2 / 32), (5, 0, 2 / 32), (0, 0, 1.0), (3, 3, 1.0), (10, 2, 0.03857)]
)
def test_mcnemar(b, c, p):
    assert mcnemar_exact(b, c) == pytest.approx(p, abs=5e-6)


def test_bootstrap_covers_the_true_median():
    rng = np.random.default_rng(0)
    draws = rng.exponential(size=(200, 60))
    intervals = [bootstrap(row, seed=i, resamples=500) for i, row in enumerate(draws)]
    covered = np.mean([low <= np.log(2) <= high for _, low, high in intervals])
    assert 0.9 <= covered <= 0.99


def test_bootstrap_repeats_and_has_no_value_without_trials():
    values = np.arange(9.0) ** 2
    assert bootstrap(values, 3) == bootstrap(values, 3)
    assert bootstrap(values, 3) != bootstrap(values[::2], 3)
    assert bootstrap(values).value == 16
    assert np.isnan(bootstrap(np.array([]))).all()


def test_a_median_has_an_interval_where_one_can_hold_in_95_percent():
    """The range of n values contains the median with a probability of 1 - 2 / 2^n."""
    for count in range(1, 9):
        interval = bootstrap(np.arange(1.0 * count))
        assert interval.value == (count - 1) / 2
        assert np.isnan(interval[1:]).all() == (1 - 2 / 2**count < CONFIDENCE)


def test_the_expected_largest_is_that_of_all_picks():
    values = np.array([3.0, 9.0, 1.0, 4.0, 7.0])
    picks = [max(pick) for pick in itertools.combinations(values, 3)]
    assert expected_largest(values, 3) == pytest.approx(np.mean(picks))
    assert expected_largest(values, 5) == 9.0 and expected_largest(values, 6) is None

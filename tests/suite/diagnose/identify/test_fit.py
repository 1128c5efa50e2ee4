"""The fit: known slopes come back, blind numbers stay, flights that differ widen the intervals."""

import numpy as np

from suite.diagnose.identify.fit import Rows, Unknown, fit

SLOPE = Unknown("slope", 0.0, -10.0, 10.0, 1.0, 1e-3)
BLIND = Unknown("blind", 4.0, -10.0, 10.0, 1.0, 1e-3)
NONE = np.array([False])


def flights(slopes, noise=0.1, count=200, seed=0):
    """Residual functions of `y = slope x + noise`, one flight a slope."""
    rng = np.random.default_rng(seed)
    made = []
    for slope in slopes:
        x = rng.normal(size=count)
        made.append((x, slope * x + noise * rng.normal(size=count), np.arange(count) // 10))

    def misses(value):
        return [Rows((y - value[0] * x)[:, None], block, NONE) for x, y, block in made]

    return misses


def test_a_slope_within_its_interval():
    found = fit(flights([2.0] * 4), [SLOPE])
    assert abs(found.value[0] - 2.0) < found.half_width[0] < 0.02


def test_a_number_that_nothing_hangs_on_stays_as_it_was():
    found = fit(flights([2.0] * 4), [SLOPE, BLIND])
    assert found.untold == ("blind",)
    assert found.value[1] == 4.0
    assert np.isnan(found.half_width[1])
    assert abs(found.value[0] - 2.0) < 0.02


def test_flights_that_differ_are_the_units():
    alike = fit(flights([2.0] * 5), [SLOPE])
    apart = fit(flights([1.8, 1.9, 2.0, 2.1, 2.2]), [SLOPE])
    assert apart.half_width[0] > 5.0 * alike.half_width[0]
    assert abs(apart.value[0] - 2.0) < apart.half_width[0]


def test_intervals_hold_the_truth_nineteen_times_in_twenty():
    inside = [
        abs(found.value[0] - 2.0) < found.half_width[0]
        for found in (fit(flights([2.0] * 4, count=100, seed=k), [SLOPE]) for k in range(100))
    ]
    assert 0.90 <= np.mean(inside) <= 0.99

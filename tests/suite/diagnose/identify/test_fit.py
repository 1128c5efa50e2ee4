"""The fit: known slopes come back, blind numbers stay, flights that differ widen the intervals."""

import numpy as np
import pytest

from suite.diagnose.identify.fit import KnownNumbers, NoWholeWindow, Rows, Unknown, fit

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

    def residuals(value):
        return [Rows((y - value[0] * x)[:, None], block, NONE) for x, y, block in made]

    return residuals


def test_a_number_that_nothing_hangs_on_stays_and_flights_that_differ_are_the_units():
    found = fit(flights([2.0] * 4), [SLOPE, BLIND])
    assert found.not_identified == ("blind",)
    assert found.value[1] == 4.0
    assert np.isnan(found.half_width[1])
    assert abs(found.value[0] - 2.0) < 0.02
    alike = fit(flights([2.0] * 5), [SLOPE])
    apart = fit(flights([1.8, 1.9, 2.0, 2.1, 2.2]), [SLOPE])
    assert apart.half_width[0] > 5.0 * alike.half_width[0]
    assert abs(apart.value[0] - 2.0) < apart.half_width[0]


def test_intervals_hold_the_truth_nineteen_times_in_twenty():
    found = [fit(flights([2.0] * 4, count=100, seed=k), [SLOPE]) for k in range(100)]
    inside = [abs(one.value[0] - 2.0) < one.half_width[0] for one in found]
    assert 0.90 <= np.mean(inside) <= 0.99 and max(one.half_width[0] for one in found) < 0.03


def test_what_is_known_widens_what_depends_on_it():
    """`y = (slope + other) x`: the slope is off by as much as the other, and by no less."""
    residuals = flights([2.0] * 4)

    def both(value):
        return residuals(np.array([value[0] + value[1]]))

    known = KnownNumbers(("other",), np.array([[0.1**2]]))
    found = fit(both, [SLOPE, Unknown("other", 0.5, -9.0, 9.0, 1.0, 1e-3)], known=known)
    alone = fit(residuals, [SLOPE])
    np.testing.assert_allclose(found.value, [1.5, 0.5], atol=0.02)
    wanted = np.hypot(alone.half_width[0], 1.96 * 0.1)
    np.testing.assert_allclose(found.half_width[0], wanted, rtol=1e-6)
    assert np.isnan(found.half_width[1]) and not found.identifies("other")
    assert found.not_identified == ()
    np.testing.assert_allclose(found.known_numbers("other", "none").covariance, [[0.01]])


def test_the_methods_own_errors_do_not_cancel_in_a_sum():
    rng, made = np.random.default_rng(0), []
    for _ in range(4):
        x = rng.normal(size=200)
        near = x + 0.2 * rng.normal(size=200)
        made.append((x, near, 2.0 * x - 1.0 * near + 0.01 * rng.normal(size=200)))
    block = np.arange(200) // 10

    def residuals(value):
        return [Rows((y - value[0] * x - value[1] * n)[:, None], block, NONE) for x, n, y in made]

    numbers = [SLOPE._replace(method_error=0.5), Unknown("other", 0.0, -9.0, 9.0, 1.0, 1e-3, 0.5)]
    found = fit(residuals, numbers)
    both = found.covariance
    assert both[0, 1] < 0.0 and np.sqrt(both[0, 0]) == pytest.approx(0.5 / 1.96, rel=0.01)
    assert np.sqrt(both.sum()) == pytest.approx(np.sqrt(2.0) * 0.5 / 1.96, rel=0.01)


def test_intervals_of_few_blocks_are_as_much_wider_as_students_t():
    few, many = (
        [fit(flights([2.0], count=count, seed=k), [SLOPE]).half_width[0] for k in range(40)]
        for count in (40, 2000)
    )
    # 4 blocks of 10 rows: t(3) = 3.18 in place of 1.96; the jackknife itself is a bit wider still.
    ratio = np.sqrt(np.mean(np.square(few)) * 40) / np.sqrt(np.mean(np.square(many)) * 2000)
    assert 1.6 < ratio < 3.0


def test_missing_values_are_left_out_and_a_fit_without_rows_is_refused():
    with pytest.raises(NoWholeWindow):
        fit(flights([2.0], count=0), [SLOPE])
    residuals = flights([2.0] * 4)

    def with_holes(value):
        rows = residuals(value)
        for one in rows:
            one.value[::3] = np.nan
        return rows

    found = fit(with_holes, [SLOPE])
    assert abs(found.value[0] - 2.0) < found.half_width[0] < 0.03

"""A name that motors' answers to slow torques make up is told by fast changes."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from suite.diagnose.evidence.moments import ViewData, fast_share, successive_changes
from suite.diagnose.evidence.views import fast_changes_agree
from suite.diagnose.thresholds import THRESHOLDS

ROWS, STEP_S = 1200, 0.05


def data_of(residual, slope):
    """Two flights of one minute; `slope` (M, 3) is that along the only number."""
    flight = np.repeat([0, 1], ROWS // 2)
    middle_s = np.tile(STEP_S * np.arange(ROWS // 2), 2)
    return ViewData(
        flight, middle_s, slope, residual, slope[..., None], np.zeros((len(flight), 3, 0))
    )


def fitted(slow, *, closed_loop, seed=0) -> tuple[Any, np.ndarray]:
    """A thrust scale fitted under motors that answer a slow torque, or to less thrust."""
    rng = np.random.default_rng(seed)
    slow = slow * gaussian_filter1d(rng.standard_normal((ROWS, 3)), 20.0, axis=0) * 8.0
    fast, noise = rng.standard_normal((2, ROWS, 3))
    motors = fast - slow if closed_loop else fast + slow
    measured = motors + slow if closed_loop else 0.6 * motors
    lacks = measured + 0.1 * noise - motors
    away = float((lacks * motors).sum() / (motors**2).sum())
    data = data_of(lacks - away * motors, motors)
    return SimpleNamespace(along=(0,), data=data), np.array([away])


@pytest.mark.parametrize("slow", [1.0, 3.0])
def test_what_motors_answer_is_no_weak_thrust(slow):
    found, away = fitted(slow, closed_loop=True)
    assert away[0] < -0.3, "it does look like less thrust"
    share, half_width = fast_share(found.data, [0], away, THRESHOLDS)
    assert share + half_width < 0.3
    assert not fast_changes_agree(found, [0], away, THRESHOLDS)


def test_less_thrust_is_so_for_slow_and_fast_changes():
    found, away = fitted(1.0, closed_loop=False)
    assert away[0] == pytest.approx(-0.4, abs=0.02)
    share, half_width = fast_share(found.data, [0], away, THRESHOLDS)
    assert share == pytest.approx(1.0, abs=3.0 * half_width) and half_width < 0.1
    assert fast_changes_agree(found, [0], away, THRESHOLDS)


def test_changes_reach_across_no_hole_and_no_two_flights():
    data = data_of(np.cumsum(np.ones((ROWS, 3)), axis=0), np.ones((ROWS, 3)))
    kept = np.ones(ROWS, bool)
    kept[100:110] = False
    found = successive_changes(ViewData(*(field[kept] for field in data)))
    assert len(found.flight) == ROWS - 10 - 1 - 2
    np.testing.assert_array_equal(found.residual, 1.0)
    np.testing.assert_array_equal(found.slope, 0.0)


def test_means_of_flights_have_no_changes():
    found, away = fitted(1.0, closed_loop=True)
    few = ViewData(*(field[[0, -1]] for field in found.data))
    found: Any = SimpleNamespace(along=(0,), data=few)
    assert fast_changes_agree(found, [0], away, THRESHOLDS)

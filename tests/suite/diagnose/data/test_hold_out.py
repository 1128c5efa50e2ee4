"""Held out is what can be spared."""

import numpy as np
import pytest

from suite.diagnose.data.flights import choose_held_out
from suite.diagnose.data.windows import cut
from tests.support.diagnosis_flights import fly_all
from tests.support.vehicles import PLAIN, with_lag

LAGGED = with_lag(PLAIN, 0.03)


@pytest.fixture(scope="module")
def three():
    logs = fly_all([LAGGED] * 3, range(3), duration_s=4.0)
    windows, _ = cut(logs, LAGGED, False)
    return logs, windows


def test_a_flight_that_alone_tells_of_something_is_fitted(three):
    logs, windows = three
    told = np.ones((len(windows.flight), 2))
    told[windows.flight != 2, 1] = 1e-3
    inside, names = choose_held_out(logs, windows.flight, windows.start_s, told)
    assert names == ["flight_1"]
    assert set(windows.flight[inside]) == {0, 2}


def test_of_a_lone_flight_the_end_is_held_out(three):
    logs, _ = three
    windows, _ = cut(logs[:1], LAGGED, False)
    assert windows is not None
    inside, names = choose_held_out(
        logs[:1], windows.flight, windows.start_s, np.ones((len(windows.flight), 1))
    )
    assert names == ["flight_0 from 2.8 s"]
    assert inside.any() and not inside[-1]

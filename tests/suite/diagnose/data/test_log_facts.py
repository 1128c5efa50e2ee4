"""What a report says of a log first."""

import numpy as np
import pytest

from suite.diagnose.verdict.checks import facts_of
from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN


def test_the_facts_of_a_log():
    log = fly(PLAIN, 0, duration_s=3.0, motors=True)
    log.pos_w[30:60] = np.nan
    found = facts_of(log)
    assert found.rows == 301 and found.duration_s == pytest.approx(3.0)
    assert found.rate_hz == pytest.approx(100.0) and found.missing == pytest.approx(30 / 301)
    assert found.channels == "commands, velocity, rotor speeds"

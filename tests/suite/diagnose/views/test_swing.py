"""A load on a line makes an oscillating force; a flight that goes to and fro does not."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suite.diagnose.data.view import SmoothedFlight, weak_form
from suite.diagnose.diagnose import diagnose
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.report.summary import next_steps
from suite.diagnose.verdict.disturbances import Swing, find_swing
from tests.support.real_flights import VEHICLE, flights

TIME_S = np.arange(0.0, 20.0, 0.01)


def made(period_s, pull, moved, rng, noise=0.1):
    """Return a level flight that moves by `moved`, and its residual: a `pull` at a period."""
    form = weak_form(TIME_S, np.ones(len(TIME_S), bool), 0.2, 0.1)
    turn = 2.0 * np.pi * form.middle_s[:, None] / period_s + rng.uniform(0.0, 6.0, 3)
    left = pull * np.sin(turn) + noise * rng.standard_normal(turn.shape)
    measured = moved * np.sin(turn + 1.0) + left
    rows: Any = SimpleNamespace(rot_w=np.broadcast_to(np.eye(3), (len(TIME_S), 3, 3)))
    return SmoothedFlight(rows, form, measured), left


def swing_of(*flights):
    return find_swing([flight for flight, _ in flights], [left for _, left in flights])


def test_a_pull_at_one_period_is_a_swing_and_own_motion_noise_or_other_periods_are_none():
    rng = np.random.default_rng(0)
    found = swing_of(*(made(1.4, 0.3, 0.1, rng) for _ in range(3)))
    assert found is not None and found.ci95[0] < 1.4 < found.ci95[1]
    assert found.ci95[1] - found.ci95[0] < 0.2 and found.p_value < 1e-3
    assert found.length_m == pytest.approx(9.81 * found.period_s**2 / 39.48, rel=1e-3)
    assert "1.4" in found.words and "0.49 m" in Swing(1.4, (1.3, 1.5), 0.5, 0.0).words
    for seed in range(10):
        rng = np.random.default_rng(seed)
        assert swing_of(*(made(1.4, 0.0, 0.0, rng) for _ in range(3))) is None
    assert swing_of(*(made(1.4, 0.3, 3.0, rng) for _ in range(3))) is None
    assert swing_of(*(made(period_s, 0.1, 0.0, rng) for period_s in (0.7, 1.0, 1.5, 2.2))) is None
    assert find_swing([], []) is None


@pytest.mark.slow
def test_a_load_on_a_line_is_said_to_swing_with_its_period():
    logs = flights(4, seed=1, duration_s=10.0, speed=1.0, load=(0.08, 0.5))
    found = diagnose(logs, VEHICLE, by="views")
    swing = found.findings[0].remaining.swing
    assert found.label in ("partly", "unknown") and swing is not None
    # A pendulum on a free body of 0.75 kg swings faster than on a wall, by sqrt(1 + 0.08 / 0.75).
    assert swing.period_s == pytest.approx(1.42 / np.sqrt(1.0 + 0.08 / 0.75), rel=0.08)
    entries = diagnosis_json(found)
    steps = " ".join(next_steps(entries))
    assert f"length = {swing.length_m:.2g} into [effects.slung_load]" in steps
    assert "oscillates with a period of 1." in entries["unexplained"]["where"]

"""Legs of a flight: how far, how slow, how often around."""

import numpy as np
import pytest

from suite.experiments.study.legs import legs
from tests.support.laps import GATES, RADIUS_M, STEP_M, flown


def test_a_straight_flight_and_a_circle_before_a_gate():
    _, straight = flown(lap_s=4.0)
    found = legs(straight)
    assert [leg.gate for leg in found] == list(range(GATES))
    assert sum(leg.time_s for leg in found) == pytest.approx(4.0)
    assert all(leg.path_m == pytest.approx(STEP_M, rel=0.02) for leg in found)
    assert max(leg.turns for leg in found) < 1e-9
    _, around = flown(lap_s=4.0, circles_at=2)
    turned = {leg.gate: leg for leg in legs(around)}
    assert turned.pop(2).turns == pytest.approx(1.0, abs=0.05)
    assert legs(around)[2].path_m == pytest.approx(STEP_M + 2 * np.pi * RADIUS_M, rel=0.03)
    assert max(leg.turns for leg in turned.values()) < 0.05
    rows = {name: getattr(straight, name)[:0] for name in ("time_s", "pos_w", "vel_w", "gate")}
    assert legs(straight._replace(**rows)) == [], "a flight that ended where it began"


def test_a_start_from_rest_counts_as_no_turn_and_no_halt():
    _, flight = flown(lap_s=4.0)
    slow, count = np.zeros_like(flight.vel_w), 20
    slow[:count, 1] = 0.1 * (-1.0) ** np.arange(count)
    flight = flight._replace(
        vel_w=np.where(np.arange(len(slow))[:, None] < count, slow, flight.vel_w)
    )
    first = legs(flight)[0]
    assert first.turns < 1e-9 and first.slowest > 1.0

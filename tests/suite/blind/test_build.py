"""A case is built the same to the bit, and what is hidden is in its logs."""

import numpy as np
import pytest

from suite.blind.build import build
from suite.blind.cases import Case
from tests.support.blind import SINGLE

pytestmark = pytest.mark.usefixtures("short_flights")


def test_a_case_is_the_same_to_the_bit_and_its_seed_matters():
    first, again = build(SINGLE), build(SINGLE)
    np.testing.assert_array_equal(first.logs[0].pos_w, again.logs[0].pos_w)
    assert first.answer == again.answer
    other = build(Case("single", ("linear_drag",), 6.0, "bare", "estimator", (6, 1)))
    assert other.answer["effects"][0]["parameters"] != first.answer["effects"][0]["parameters"]


def test_what_is_hidden_is_in_the_logs_and_not_in_the_vehicle_file():
    built = build(SINGLE)
    assert "linear_drag" not in built.nominal.effects
    coefficient = np.array(built.answer["effects"][0]["parameters"]["coefficient"])
    flight = built.recordings[0]
    vel_b = np.einsum("tij,ti->tj", flight.motion.rot_w, flight.motion.vel_w)
    # The accelerometer of a vehicle without other aerodynamics shows the drag alone across.
    across = flight.acc_b[1:, :2]
    np.testing.assert_allclose(across, -coefficient[:2] * vel_b[:-1, :2], rtol=1e-6, atol=1e-9)
    assert built.answer["effects"][0]["sigma"] > 0.0


def test_outside_cases_say_how_much_the_catalogue_cannot_explain():
    built = build(Case("outside", ("ripple",), 6.0, "bare", "capture", (5, 3)))
    outside = built.answer["outside"]
    assert built.answer["verdict"] == "unknown" and not built.truth.effects
    assert outside["multiple"] == pytest.approx(6.0, rel=0.25) or outside["strength"] == 0.3

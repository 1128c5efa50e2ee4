"""Jumps, repeated and filled-in samples are left out and told; a good flight is left alone."""

import numpy as np
import pytest

from eval.importers.checks.glitches import clean
from eval.importers.signals import Recording, Signal
from tests.support import known_flight


@pytest.fixture
def signals():
    truth = known_flight.fly(np.arange(0, 6, 0.01))
    rng = np.random.default_rng(3)
    quat = truth.quat + 2e-4 * rng.normal(size=truth.quat.shape)
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return {
        "pos": Signal(truth.time, truth.pos + 2e-4 * rng.normal(size=truth.pos.shape)),
        "vel": Signal(truth.time, truth.vel + 0.01 * rng.normal(size=truth.vel.shape)),
        "quat": Signal(truth.time, quat),
    }


def test_a_good_flight_is_left_as_it_is(signals):
    cleaned, findings = clean(Recording("log", signals))
    assert findings == []
    for name, samples in signals.items():
        np.testing.assert_array_equal(cleaned.signals[name].value, samples.value)


def test_a_jump_of_position_and_one_of_speed_are_left_out(signals):
    signals["pos"].value[200] += [0.0, 0.5, 0.0]
    signals["vel"].value[320] += [1.0, 0.0, 0.0]
    cleaned, findings = clean(Recording("log", signals))
    assert 2.0 not in cleaned.signals["pos"].time_s
    assert len(cleaned.signals["pos"].time_s) == 599
    assert np.abs(cleaned.signals["vel"].time_s - 3.2).min() > 0.005
    assert {finding.subject for finding in findings} == {"position", "velocity"}


def test_repeated_poses_are_left_out_with_what_is_logged_with_them(signals):
    for name in ("pos", "quat", "vel"):
        signals[name].value[1::3] = signals[name].value[0::3]
    cleaned, findings = clean(Recording("log", signals))
    for name in ("pos", "quat", "vel"):
        assert len(cleaned.signals[name].time_s) == 400
    assert "33 % of the poses repeat" in findings[0].text


def test_whole_millimetres_are_not_repeats(signals):
    coarse = np.round(0.02 * signals["pos"].value, 3)
    cleaned, findings = clean(Recording("log", {"pos": Signal(signals["pos"].time_s, coarse)}))
    assert len(cleaned.signals["pos"].time_s) == 600
    assert not [finding for finding in findings if "repeat" in finding.text]


def test_attitudes_drawn_between_their_neighbours_are_left_out(signals):
    quat = signals["quat"].value
    middle = quat[0:-2:2] + quat[2::2]
    quat[1:-1:2] = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    cleaned, findings = clean(Recording("log", {"quat": signals["quat"]}))
    assert len(cleaned.signals["quat"].time_s) < 340
    assert "drawn between their neighbours" in findings[0].text

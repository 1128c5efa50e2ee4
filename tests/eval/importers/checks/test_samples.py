"""Bad samples and time on the ground are found; good logs stay."""

import numpy as np
import pytest

from eval.importers.checks.airborne import airborne
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
    assert {finding.signal for finding in findings} == {"position", "velocity"}


def test_repeated_poses_are_left_out_with_what_is_logged_with_them(signals):
    for name in ("pos", "quat", "vel"):
        signals[name].value[1::3] = signals[name].value[0::3]
    cleaned, findings = clean(Recording("log", signals))
    for name in ("pos", "quat", "vel"):
        assert len(cleaned.signals[name].time_s) == 400
    assert "33 % of the poses repeat" in findings[0].evidence


def test_whole_millimetres_are_not_repeats(signals):
    coarse = np.round(0.02 * signals["pos"].value, 3)
    cleaned, findings = clean(Recording("log", {"pos": Signal(signals["pos"].time_s, coarse)}))
    assert len(cleaned.signals["pos"].time_s) == 600
    assert not [finding for finding in findings if "repeat" in finding.evidence]


def test_attitudes_drawn_between_their_neighbours_are_left_out(signals):
    quat = signals["quat"].value
    middle = quat[0:-2:2] + quat[2::2]
    quat[1:-1:2] = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    cleaned, findings = clean(Recording("log", {"quat": signals["quat"]}))
    assert len(cleaned.signals["quat"].time_s) < 340
    assert "are interpolated" in findings[0].evidence


TIME = np.arange(0, 10, 0.01)


def recording(lift=2.0, land=8.0, ground=0.3):
    height = np.interp(TIME, [0, lift, lift + 1, land - 1, land, 10], [0, 0, 1, 1, 0, 0]) + ground
    # The motors run up half a second before they lift, and stop a while after touching down.
    pwm = np.interp(TIME, [0, lift - 0.5, lift, land, land + 0.3], [0, 0, 0.6, 0.6, 0])
    pos = np.stack([0 * TIME, 0 * TIME, height], axis=1)
    return Recording(
        "log", {"pos": Signal(TIME, pos), "pwm": Signal(TIME, np.repeat(pwm[:, None], 4, 1))}
    )


def test_the_flight_is_found_between_take_off_and_landing():
    (start, stop), findings = airborne(recording())
    # It rises by 1 m in the second after lifting: 5 cm after 0.05 s.
    np.testing.assert_allclose([start, stop], [2.06, 7.94], atol=0.02)
    assert "2.1 s before take-off" in findings[0].evidence
    assert "2.0" in findings[0].evidence or "2.1 s after landing" in findings[0].evidence


def test_a_log_that_flies_from_the_start_is_not_cut():
    whole = recording()
    inside = (TIME > 3) & (TIME < 6)
    cut = {n: Signal(s.time_s[inside], s.value[inside]) for n, s in whole.signals.items()}
    (start, stop), findings = airborne(Recording("log", cut))
    assert (start, stop) == (-np.inf, np.inf)
    assert findings[0].status == "ok"


def test_without_motors_nothing_is_cut_and_that_is_said():
    lone = Recording("log", {"pos": recording().signals["pos"]})
    (start, stop), findings = airborne(lone)
    assert (start, stop) == (-np.inf, np.inf)
    assert "no signal shows when the motors run" in findings[0].evidence

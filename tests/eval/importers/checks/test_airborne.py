"""Take-off and landing are found by motors and height; a log that flies already is left alone."""

import numpy as np

from eval.importers.checks.airborne import airborne
from eval.importers.signals import Recording, Signal

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
    assert "2.1 s before take-off" in findings[0].text
    assert "2.0" in findings[0].text or "2.1 s after landing" in findings[0].text


def test_a_log_that_flies_from_the_start_is_not_cut():
    whole = recording()
    inside = (TIME > 3) & (TIME < 6)
    cut = {n: Signal(s.time_s[inside], s.value[inside]) for n, s in whole.signals.items()}
    (start, stop), findings = airborne(Recording("log", cut))
    assert (start, stop) == (-np.inf, np.inf)
    assert findings[0].level == "ok"


def test_without_motors_nothing_is_cut_and_that_is_said():
    lone = Recording("log", {"pos": recording().signals["pos"]})
    (start, stop), findings = airborne(lone)
    assert (start, stop) == (-np.inf, np.inf)
    assert "nothing says when the motors run" in findings[0].text

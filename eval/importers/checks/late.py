"""Is the pose late against the gyro? Motion capture is, and so is a state estimate."""

from __future__ import annotations

from dataclasses import replace

from eval.importers.signals import Recording, Signal
from eval.logs.faults.clock import LATE_S, LEAST_S, SURE, delay_of
from eval.logs.faults.finding import Finding

LATE = ("pos", "quat", "vel")
"""Signals that come of one device and are late together."""


def check_delay(recording: Recording, fix: bool) -> tuple[Recording, list[Finding]]:
    """Return the recording with the pose moved to when the gyro felt it, and what was found.

    Args:
        recording: time in s, rates in rad/s, frames as ours; holds quat and rate.
        fix: move it; otherwise only say so.
    """
    quat, rate = recording.signals["quat"], recording.signals["rate"]
    found = delay_of(quat.time_s, quat.value, rate.time_s, rate.value)
    if found is None:
        return recording, []
    delay, error = found.delay_s, found.error_s
    figures = f"it is {1e3 * delay:+.1f} ms (± {1e3 * error:.1f} ms) late against the gyro"
    if abs(delay) < max(LEAST_S, SURE * error):
        return recording, [Finding("ok", "pose delay", figures)]
    sure = 0.95 if abs(delay) > LATE_S else 0.8
    about = ("clock_offset", delay, sure, "leave --no-fix out: the pose is moved")
    if not fix:
        return recording, [Finding("doubt", "pose delay", f"{figures}; left as it is", *about)]
    signals = {
        name: Signal(s.time_s - delay, s.value) if name in LATE else s
        for name, s in recording.signals.items()
    }
    text = f"{figures}: pose and velocity are moved by that"
    return replace(recording, signals=signals), [Finding("corrected", "pose delay", text, *about)]

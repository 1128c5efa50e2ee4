"""Estimate and remove the delay of the pose (motion capture or state estimate) against the gyro."""

from __future__ import annotations

from dataclasses import replace

from eval.importers.signals import Recording, Signal
from eval.logs.faults.clock import LATE_S, LEAST_S, SURE, delay_of
from eval.logs.faults.finding import Finding

LATE = ("pos", "quat", "vel")
"""Signals of one device, which share a delay."""


def check_delay(recording: Recording, fix: bool) -> tuple[Recording, list[Finding]]:
    """Return the recording with the pose shifted to the gyro's clock, and the findings.

    Args:
        recording: with time in s, rates in rad/s and a flight log's frames; holds quat and rate.
        fix: shift the pose; otherwise only report the delay.
    """
    quat, rate = recording.signals["quat"], recording.signals["rate"]
    found = delay_of(quat.time_s, quat.value, rate.time_s, rate.value)
    if found is None:
        return recording, []
    delay, error = found.delay_s, found.error_s
    figures = f"it is {1e3 * delay:+.1f} ms (± {1e3 * error:.1f} ms) late against the gyro"
    is_late, findings = abs(delay) > max(LEAST_S, SURE * error), []
    keep = "leave --no-fix out: the pose is moved"
    status = "corrected" if fix else "doubt"
    if found.drifts:
        about = ("clock_drift", found.drift, 0.95, keep)
        findings.append(Finding(status, "pose clock", found.drift_figures(), *about))
    if is_late:
        sure = 0.95 if abs(delay) > LATE_S else 0.8
        text = f"{figures}: pose and velocity are moved by that" if fix else f"{figures}; left so"
        about = ("clock_offset", delay, sure, keep)
        findings.append(Finding(status, "pose delay", text, *about))
    else:
        findings.append(Finding("ok", "pose delay", figures))
    if not fix or not (is_late or found.drifts):
        return recording, findings
    drift = found.drift if found.drifts else 0.0
    by = {name: delay + drift * (s.time_s - found.middle_s)
          for name, s in recording.signals.items() if name in LATE}  # fmt: skip
    moved = {name: recording.signals[name] for name in by}
    signals = {name: Signal(s.time_s - by[name], s.value) for name, s in moved.items()}
    return replace(recording, signals={**recording.signals, **signals}), findings

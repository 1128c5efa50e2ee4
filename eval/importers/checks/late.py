"""Estimate and remove the delay of a log's pose against its gyro.

The pose comes from motion capture or a state estimator, whose clock may be late and may drift.
"""

from __future__ import annotations

from dataclasses import replace

from eval.importers.signals import Recording, Signal
from eval.logs.faults.clock import LATE_S, LEAST_S, SURE, delay_of
from eval.logs.faults.finding import Finding

OF_POSE = ("pos", "quat", "vel")
"""Signals of the device that measures the pose; they share its delay."""


def check_delay(recording: Recording, fix: bool) -> tuple[Recording, list[Finding]]:
    """Return the recording with the pose shifted to the gyro's clock, and the findings.

    The recording has times in s, rates in rad/s and a flight log's frames; it must have quat and
    rate. Without `fix` the delay is only reported.
    """
    quat, rate = recording.signals["quat"], recording.signals["rate"]
    fit = delay_of(quat.time_s, quat.value, rate.time_s, rate.value)
    if fit is None:
        return recording, []
    delay, error = fit.delay_s, fit.error_s
    figures = f"it is {1e3 * delay:+.1f} ms (± {1e3 * error:.1f} ms) late against the gyro"
    is_late, findings = abs(delay) > max(LEAST_S, SURE * error), []
    option = "leave --no-fix out: the import shifts the pose"
    status = "corrected" if fix else "doubt"
    if fit.drifts:
        about = ("clock_drift", fit.drift, 0.95, option)
        findings.append(Finding(status, "pose clock", fit.drift_figures(), *about))
    if is_late:
        confidence = 0.95 if abs(delay) > LATE_S else 0.8
        text = f"{figures}: pose and velocity are shifted" if fix else f"{figures}; not corrected"
        about = ("clock_offset", delay, confidence, option)
        findings.append(Finding(status, "pose delay", text, *about))
    else:
        findings.append(Finding("ok", "pose delay", figures))
    if not fix or not (is_late or fit.drifts):
        return recording, findings
    drift = fit.drift if fit.drifts else 0.0
    signals = dict(recording.signals)
    for name in OF_POSE:
        if name in signals:
            time_s, value = signals[name]
            signals[name] = Signal(time_s - (delay + drift * (time_s - fit.middle_s)), value)
    return replace(recording, signals=signals), findings

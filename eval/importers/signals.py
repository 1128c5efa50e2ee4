"""Signals of an imported file, in the flight log's units and frames, each at its own rate.

Signals are named as the groups of columns in `eval/logs/columns.py` (pos, quat, vel, rate,
cmd_thrust, cmd_rate, motor, motor_cmd, acc, voltage), and besides `throttle`: normalised
collective thrust from 0 to 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from eval.logs.columns import LARGEST, FlightLogError
from eval.logs.faults.finding import Finding
from eval.logs.faults.reading import TIMES, Readings, option, read_as

NEEDED = ("pos", "quat", "rate")
"""What a flight cannot do without."""
BACKWARDS_MAX = 0.05
"""Largest share of rows with non-increasing time in an accepted signal."""
LEAST_STEP = 1e-15
"""Least step of increasing times, so that a division by it does not overflow."""


class Signal(NamedTuple):
    """Samples of one signal."""

    time_s: np.ndarray
    """(N,) increasing [s]."""
    value: np.ndarray
    """(N, C) in the flight log's unit and frame."""


@dataclass(frozen=True)
class Recording:
    """What a file holds."""

    name: str
    """The file, for messages."""
    signals: Mapping[str, Signal]
    """By name; see the head of this file."""
    findings: tuple[Finding, ...] = ()
    """What was noticed while reading."""
    motor_side: tuple[tuple[float, float], ...] | None = None
    """For the file's motors 1 to 4: where they are, (x forward, y left), in any length unit."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """Metadata of the file: firmware, airframe, start."""


def signal(
    time_s: np.ndarray, value: np.ndarray, name: str, what: str
) -> tuple[Signal | None, Finding | None]:
    """Return the finite samples of increasing time, and a finding on the others.

    Args:
        time_s: (N,) [s], NaN where unknown.
        value: (N,) or (N, C); rows with a NaN are left out.
        name: the file, for messages.
        what: the signal, for messages.

    Raises:
        FlightLogError: where time goes back too often: two flights in one file, or a wrong column;
            where numbers are so large that they are damage.
    """
    time_s = np.asarray(time_s, dtype=np.float64)
    if not len(time_s):
        return None, None
    value = np.asarray(value, dtype=np.float64).reshape(len(time_s), -1)
    known = np.isfinite(time_s) & np.isfinite(value).all(axis=1)
    time_s, value = time_s[known], value[known]
    if not len(time_s):
        return None, None
    _refuse_damage(time_s, value, name, what)
    forward = np.ones(len(time_s), dtype=bool)
    forward[1:] = time_s[1:] - np.maximum.accumulate(time_s)[:-1] > LEAST_STEP
    back = int(np.sum(~forward))
    if back > BACKWARDS_MAX * len(time_s):
        row = int(np.argmin(forward)) + 1
        reason = (
            f"time does not increase in {back} of {len(time_s)} samples of {what!r}; "
            "cut the file to one flight, and check which column is the time"
        )
        raise FlightLogError(name, "time", row, reason)
    note = f"{back} samples of {what!r} whose time does not increase are left out"
    finding = Finding("note", "time", note) if back else None
    return Signal(time_s[forward], value[forward]), finding


def _refuse_damage(time_s: np.ndarray, value: np.ndarray, name: str, what: str) -> None:
    largest = max(np.abs(time_s).max(), np.abs(value).max(initial=0.0))
    if largest > LARGEST:
        reason = f"holds numbers up to {largest:.3g}, allowed are {LARGEST:g}; log or copy it again"
        raise FlightLogError(name, what, None, reason)


def collect(
    parts: Mapping[str, tuple[np.ndarray, np.ndarray]], name: str
) -> tuple[dict[str, Signal], tuple[Finding, ...]]:
    """Return the signals of `parts` (name to time and values) that hold samples, and findings."""
    signals, findings = {}, []
    for what, (time_s, value) in parts.items():
        try:
            made, finding = signal(time_s, value, name, what)
        except FlightLogError as error:
            if what in NEEDED:
                raise
            # What a flight can do without is left out, and the rest is read.
            text = f"{what!r} is left out: {error.reason}"
            about = ("time_stamps", None, 0.95, option((what, "drop")))
            made, finding = None, Finding("corrected", what, text, *about)
        if made is not None:
            signals[what] = made
        if finding is not None:
            findings.append(finding)
    return signals, tuple(findings)


def with_readings(recording: Recording, readings: Readings) -> Recording:
    """Return a recording whose signals are read in another way; see `eval.logs.faults.reading`."""
    signals = dict(recording.signals)
    for name, steps in readings:
        if name == "time":
            scale = TIMES[steps]
            signals = {n: Signal(s.time_s * scale, s.value) for n, s in signals.items()}
        elif steps == "drop":
            signals.pop(name, None)
        elif name in signals:
            samples = signals[name]
            attitude = partial(_nearest_attitude, signals.get("quat"), samples.time_s)
            signals[name] = samples._replace(value=read_as(name, samples.value, steps, attitude))
    return replace(recording, signals=signals)


def _nearest_attitude(quat: Signal | None, at: np.ndarray) -> np.ndarray:
    if quat is None:
        raise ValueError("--read from-body, from-world and plus-gravity need an attitude")
    near = np.clip(np.searchsorted(quat.time_s, at), 0, len(quat.time_s) - 1)
    return quat.value[near] / np.linalg.norm(quat.value[near], axis=1, keepdims=True)


def median_step(time_s: np.ndarray) -> float:
    """Return the median distance of samples [s]; infinite for fewer than two."""
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else np.inf

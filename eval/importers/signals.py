"""Containers for the signals of an imported file, each at its own rate, and their first cleaning.

Signals have the flight log's units and frames. They are named as the groups of columns in
`eval/logs/columns.py`. Others are `throttle` (the normalised collective thrust from 0 to 1),
`cmd_quat` (commanded attitudes), and columns that are kept unchanged (`kept:NAME`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from eval.logs.columns import GROUPS, LARGEST, FlightLogError
from eval.logs.faults.finding import Finding
from eval.logs.faults.reading import QUATS, Readings, option, read_as, seconds
from tracks.common.names import unknown_name

KEPT = "kept:"
"""Prefix of the name of a column that is kept unchanged."""
WIDTHS = {name: len(columns) for name, columns in GROUPS.items() if name != "time"} | {
    "throttle": 1,
    "cmd_quat": 4,
}
"""Name of a signal -> number of its columns."""
NEEDED = ("pos", "quat", "rate")
"""Signals that a flight log must have; a partial log lacks some of them."""
BACKWARDS_MAX = 0.05
"""Largest share of samples with non-increasing time in an accepted signal."""
MAD_TO_SD = 1.4826
"""Factor from a median absolute deviation to the standard deviation of normal noise."""
LEAST_NORM = 1e-3
"""Quaternions with a smaller norm are no attitudes: motion capture writes zeros without a body."""
FAR_STEPS = 5.0
"""A placeholder is further from the positions next to it than so many of their usual steps."""
LEAST_STEP = 1e-15
"""Least step of increasing times, so that a division by it does not overflow."""


Part = tuple[np.ndarray, np.ndarray]
"""Times (N,) [s] and samples, (N,) or (N, C), as a file has them; NaN where unknown."""


class Signal(NamedTuple):
    """Samples of one signal."""

    time_s: np.ndarray
    """(N,) increasing times [s]."""
    value: np.ndarray
    """(N, C) samples in the flight log's unit and frame."""


@dataclass(frozen=True)
class Recording:
    """The signals of a file, before they are resampled to the rows of a flight log."""

    name: str
    """Name of the file, for messages."""
    signals: Mapping[str, Signal]
    """Signals by name; the module's docstring lists the names."""
    findings: tuple[Finding, ...] = ()
    """Results of the checks so far."""
    motor_side: tuple[tuple[float, float], ...] | None = None
    """Positions (x forward, y left) of motors 1 to 4 in any unit; None: the vehicle's order."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """Metadata of the file: firmware, airframe, start."""
    has_seconds: bool = False
    """Whether the format defines the unit of time; otherwise the import checks it."""

    def noting(self, *findings: Finding) -> Recording:
        """Return the recording with more findings."""
        return replace(self, findings=(*self.findings, *findings))


def make_signal(
    time_s: np.ndarray, value: np.ndarray, file: str, name: str
) -> tuple[Signal | None, Finding | None]:
    """Return the finite samples with increasing time (None without any), and a note on the others.

    `time_s` is (N,) [s], samples are (N,) or (N, C); NaN where unknown.

    Raises:
        FlightLogError: where time decreases too often (two flights in one file, or a wrong
            column), or numbers are too large to be measurements.
    """
    time_s = np.asarray(time_s, dtype=np.float64)
    if not len(time_s):
        return None, None
    value = np.asarray(value, dtype=np.float64).reshape(len(time_s), -1)
    finite = np.isfinite(time_s) & np.isfinite(value).all(axis=1)
    time_s, value = time_s[finite], value[finite]
    if not len(time_s):
        return None, None
    largest = max(np.abs(time_s).max(), np.abs(value).max(initial=0.0))
    if largest > LARGEST:
        reason = f"holds numbers up to {largest:.3g}, allowed are {LARGEST:g}; log or copy it again"
        raise FlightLogError(file, reason, name)
    # Keep a sample only if it is later than all samples before it.
    forward = np.ones(len(time_s), dtype=bool)
    forward[1:] = time_s[1:] - np.maximum.accumulate(time_s)[:-1] > LEAST_STEP
    backwards = int(np.sum(~forward))
    if backwards > BACKWARDS_MAX * len(time_s):
        row = int(np.flatnonzero(finite)[np.argmin(forward)]) + 1
        steps_back = int(np.sum(np.diff(time_s) < 0.0))
        advice = "cut the file to one flight, and check which column is the time"
        if not steps_back:
            advice = "drop repeated rows, or write the time with more digits"
        elif steps_back > BACKWARDS_MAX * len(time_s):
            advice = "sort the rows by time, and check which column is the time"
        reason = f"time does not increase in {backwards} of {len(time_s)} samples of {name!r}; "
        reason += advice
        raise FlightLogError(file, reason, "time", row)
    note = f"{backwards} samples of {name!r} whose time does not increase are left out"
    finding = Finding("note", "time", note) if backwards else None
    return Signal(time_s[forward], value[forward]), finding


def check_recording(recording: Any, format: str) -> None:
    """Refuse a result of a format's `read` whose signals would be ignored or misread.

    Raises:
        ValueError: for another type than a `Recording`, an unknown signal, or a wrong shape.
    """
    if not isinstance(recording, Recording):
        raise ValueError(f"format {format!r} reads a {type(recording).__name__}, not a Recording")
    for name, samples in recording.signals.items():
        if name.startswith(KEPT):
            continue
        if name not in WIDTHS:
            raise unknown_name(f"signal of the format {format!r}", name, [*WIDTHS, f"{KEPT}NAME"])
        wanted, shape = (len(samples.time_s), WIDTHS[name]), np.shape(samples.value)
        if shape != wanted:
            raise ValueError(f"format {format!r} reads {name!r} of shape {shape}, not {wanted}")


def collect(parts: Mapping[str, Part], file: str) -> tuple[dict[str, Signal], tuple[Finding, ...]]:
    """Return the signals that have samples, and findings on samples that were left out.

    Raises:
        FlightLogError: where a signal of `NEEDED` is unusable; another unusable signal is dropped.
    """
    signals, findings = {}, []
    for name, (time_s, value) in parts.items():
        if name in QUATS:
            is_lost = np.linalg.norm(value, axis=1) < LEAST_NORM
            value = np.where(is_lost[:, None], np.nan, value)
            if is_lost.any():
                text = f"{np.sum(is_lost)} samples of {name!r} are zeros, no attitude: left out"
                findings.append(Finding("note", "attitude", text))
        if name == "pos":
            value, notes = _without_placeholders(value)
            findings += notes
        try:
            samples, finding = make_signal(time_s, value, file, name)
        except FlightLogError as error:
            if name in NEEDED:
                raise
            text = f"{name!r} is left out: {error.reason}"
            about = ("time_stamps", None, 0.95, option((name, "drop")))
            samples, finding = None, Finding("corrected", name, text, *about)
        if samples is not None:
            signals[name] = samples
        if finding is not None:
            findings.append(finding)
    return signals, tuple(findings)


def _without_placeholders(pos: np.ndarray) -> tuple[np.ndarray, list[Finding]]:
    """Return positions (N, 3) with NaN where a number stands for "unknown", and the notes.

    Such a position is zero or recurs exactly, and the steps to it and from it are far.
    """
    findings = []
    while True:
        known = np.flatnonzero((np.abs(pos) <= LARGEST).all(axis=1))
        value = np.ascontiguousarray(pos[known] + 0.0)  # no -0.0, which has other bytes
        _, first, index, count = np.unique(
            value.view([("", value.dtype)] * 3)[:, 0], True, True, True
        )
        usual = value[first[np.argmax(count)]] if len(known) else np.zeros(3)
        is_it = index == np.argmax(count) if len(known) else np.zeros(0, dtype=bool)
        rest = np.linalg.norm(np.diff(value[~is_it], axis=0), axis=1)
        enters, leaves = (np.flatnonzero(np.diff(is_it.astype(int)) == k) for k in (1, -1))
        size = np.linalg.norm(np.diff(value, axis=0), axis=1)
        steps = [float(np.median(size[k])) for k in (enters, leaves) if len(k)]
        recurs = max(len(enters), len(leaves)) > 1 or not usual.any()
        if not (steps and recurs and rest.any()):
            return pos, findings
        if min(steps) < FAR_STEPS * float(np.median(rest[rest > 0.0])):
            return pos, findings
        pos = pos.copy()
        pos[known[is_it]] = np.nan
        text = f"{is_it.sum()} samples are {', '.join(f'{v:g}' for v in usual)}, no position"
        findings.append(Finding("note", "position", f"{text}: left out"))


def with_readings(recording: Recording, readings: Readings) -> Recording:
    """Return the recording with converted signals, see `eval.logs.faults.reading`.

    Raises:
        ValueError: for a conversion that needs an attitude, where the recording has none.
    """
    signals = dict(recording.signals)
    for name, steps in readings:
        if name == "time":
            scale = seconds(steps)
            signals = {n: Signal(s.time_s * scale, s.value) for n, s in signals.items()}
        elif steps == "drop":
            signals.pop(name, None)
        elif name in signals:
            samples = signals[name]
            attitude = partial(_next_attitude, signals.get("quat"), samples.time_s)
            signals[name] = samples._replace(value=read_as(name, samples.value, steps, attitude))
    return replace(recording, signals=signals)


def _next_attitude(quat: Signal | None, time_s: np.ndarray) -> np.ndarray:
    """Return for each time of `time_s` (T,) the first attitude from then on, wxyz (T, 4)."""
    if quat is None:
        raise ValueError("--read from-body, from-world and plus-gravity need an attitude")
    index = np.clip(np.searchsorted(quat.time_s, time_s), 0, len(quat.time_s) - 1)
    return quat.value[index] / np.linalg.norm(quat.value[index], axis=1, keepdims=True)


def median_step(time_s: np.ndarray) -> float:
    """Return the median time between samples [s]; infinite for fewer than two."""
    return float(np.median(np.diff(time_s))) if len(time_s) > 1 else np.inf

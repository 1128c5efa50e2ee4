"""Is the pose late against the gyro? Motion capture is, and so is a state estimate.

The attitude's turn over 60 ms is held against the gyro's mean over the same time, moved by a trial
delay; where they differ least is the delay. Its error comes from blocks of the flight that are
left out in turn (jackknife).
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from eval.importers.checks.attitude import (
    BAD,
    GOOD,
    READINGS,
    SPAN_S,
    TIMES_BETTER,
    as_read,
)
from eval.importers.findings import Finding
from eval.importers.frames import HALF_TURN, conjugate, multiply, rotation_vector
from eval.importers.rows import continuous
from eval.importers.signals import Recording, Signal, median_step

REACH_S, STEP_S = 0.1, 0.002
"""Delays that are tried, to both sides, and their distance [s]."""
BLOCKS = 8
LEAST_S, SURE = 0.002, 4.0
"""A delay below the first [s], or within so many standard errors of none, is left alone."""
CALM = 0.2
"""Turns slower than this tell nothing (root mean square) [rad/s]."""
LATE = ("pos", "quat", "vel")
"""Signals that come of one device and are late together."""


class Late(NamedTuple):
    """By how much an attitude is late against a gyro."""

    delay_s: float
    error_s: float
    """Standard error [s]."""
    misfit: float
    """What the two still differ by at that delay, over the gyro's turns; medians."""


def check_delay(recording: Recording, fix: bool) -> tuple[Recording, list[Finding]]:
    """Return the recording with the pose moved to when the gyro felt it, and what was found.

    Args:
        recording: time in s, rates in rad/s; holds quat and rate.
        fix: move it; otherwise only say so.
    """
    found = _delay_in_any_reading(recording.signals["quat"], recording.signals["rate"])
    if found is None:
        return recording, []
    delay, error, _ = found
    figures = f"it is {1e3 * delay:+.1f} ms (± {1e3 * error:.1f} ms) late against the gyro"
    if abs(delay) < max(LEAST_S, SURE * error):
        return recording, [Finding("ok", "pose delay", figures)]
    if not fix:
        return recording, [Finding("doubt", "pose delay", figures + "; left as it is")]
    signals = {
        name: Signal(s.time_s - delay, s.value) if name in LATE else s
        for name, s in recording.signals.items()
    }
    moved = Finding("corrected", "pose delay", figures + ": pose and velocity are moved by that")
    return replace(recording, signals=signals), [moved]


def _delay_in_any_reading(quat: Signal, rate: Signal) -> Late | None:
    """Return the delay of an attitude that may be written otherwise than it is read.

    `check_attitude` finds the reading once the pose is on time: by turns that are late it cannot.
    """
    given = delay_of(quat, rate)
    if given is not None and given.misfit < BAD:
        return given
    others = [
        delay_of(
            quat._replace(value=as_read(quat.value, order, inverse)),
            rate._replace(value=rate.value * HALF_TURN) if turned else rate,
        )
        for order, inverse, turned in READINGS[1:]
    ]
    best = min((other for other in others if other), key=lambda late: late.misfit, default=None)
    if best is None or best.misfit >= GOOD:
        return given
    return best if given is None or best.misfit * TIMES_BETTER < given.misfit else given


def delay_of(quat: Signal, rate: Signal) -> Late | None:
    """Return by how much `quat` is late against `rate`.

    None where the flight turns too little, or where the best delay is at the end of the reach.
    """
    step = median_step(quat.time_s)
    count = max(1, round(SPAN_S / step)) if np.isfinite(step) else 0
    if count == 0 or len(quat.time_s) < 20 * count or len(rate.time_s) < 100:
        return None
    value = continuous(quat.value / np.linalg.norm(quat.value, axis=1, keepdims=True))
    first, last = quat.time_s[:-count], quat.time_s[count:]
    span = last - first
    inside = (
        (span < 1.5 * count * step)
        & (first > rate.time_s[0] + REACH_S)
        & (last < rate.time_s[-1] - REACH_S)
    )
    if inside.sum() < 100:
        return None
    turns = rotation_vector(multiply(conjugate(value[:-count]), value[count:])) / span[:, None]
    first, last, turns = first[inside], last[inside], turns[inside]
    # The noise of one turn is that of two attitudes: wild ones must not decide.
    area = 0.5 * np.diff(rate.time_s)[:, None] * (rate.value[1:] + rate.value[:-1])
    full = np.concatenate([np.zeros((1, 3)), np.cumsum(area, axis=0)])

    def gyro(late_s: float) -> np.ndarray:
        at = [
            np.stack([np.interp(t - late_s, rate.time_s, c) for c in full.T], axis=1)
            for t in (first, last)
        ]
        return (at[1] - at[0]) / (last - first)[:, None]

    if np.sqrt(np.mean(np.sum(gyro(0.0) ** 2, axis=1))) < CALM:
        return None
    trials = np.arange(-REACH_S, REACH_S + 0.5 * STEP_S, STEP_S)
    block = np.minimum((np.arange(len(first)) * BLOCKS) // len(first), BLOCKS - 1)
    cost = np.empty((BLOCKS, len(trials)))
    for k, late_s in enumerate(trials):
        off = turns - gyro(late_s)
        size = np.linalg.norm(off - np.median(off, axis=0), axis=1)
        limit = 3.0 * np.median(size)
        loss = np.where(size < limit, 0.5 * size**2, limit * (size - 0.5 * limit))
        cost[:, k] = np.bincount(block, weights=loss, minlength=BLOCKS)
    whole = _lowest(trials, cost.sum(axis=0))
    parts = [_lowest(trials, cost.sum(axis=0) - cost[b]) for b in range(BLOCKS)]
    if whole is None or any(part is None for part in parts):
        return None
    left_out = np.array([part for part in parts if part is not None])
    spread = (BLOCKS - 1) / BLOCKS * np.sum((left_out - left_out.mean()) ** 2)
    felt = gyro(whole)
    off = np.median(np.linalg.norm(turns - felt, axis=1))
    misfit = float(off / np.median(np.linalg.norm(felt, axis=1)))
    return Late(whole, float(np.sqrt(spread)), misfit)


def _lowest(trials: np.ndarray, cost: np.ndarray) -> float | None:
    """Return where a parabola through the least cost and its neighbours is lowest."""
    k = int(np.argmin(cost))
    if k in (0, len(trials) - 1):
        return None
    before, here, after = cost[k - 1 : k + 2]
    bend = before - 2.0 * here + after
    move = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(trials[k] + move * (trials[1] - trials[0]))

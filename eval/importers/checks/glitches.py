"""Remove impossible samples: jumps of position and speed, repeated and interpolated samples.

A repeated or interpolated sample is no measurement and makes the noise look too small. A jump looks
like a collision.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from eval.importers.frames import conjugate, multiply, rotation_vector
from eval.importers.rows import continuous
from eval.importers.signals import Recording, Signal, median_step
from eval.logs.faults.finding import Finding
from eval.logs.velocity import velocity_from_position

ACC_MAX = 60.0
"""Largest possible acceleration [m/s^2]."""
POS_LEAST, VEL_LEAST = 0.02, 0.1
"""Smaller jumps are kept [m, m/s]."""
TIMES_USUAL = 8.0
"""A velocity further from the path's slope than this many standard deviations is a glitch."""
EDGE_S = 0.1
"""Time around a gap or an end of the positions in which velocities are not checked [s]."""
AROUND = 7
"""Number of samples of the running median with which a position is compared."""
REPEATED = 0.02
"""Share of repeated or interpolated samples above which they are removed."""
COARSE = 4.0
"""A scale is coarse where the usual change is below this many of its steps."""
TEXTS = {"pos": "position", "quat": "attitude"}
TURNING = 0.05
"""Least body rate at which an interpolated attitude is identifiable [rad/s]."""
EXACT = 1e-3
"""An attitude whose rate is constant within this share was interpolated."""


def clean(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Return the recording (time in s) without impossible samples, and the findings."""
    signals, findings = dict(recording.signals), []
    findings += _leave_repeats(signals)
    if "quat" in signals and len(signals["quat"].time_s) > AROUND:
        signals["quat"], found = _without_filled_in(signals["quat"])
        findings += found
    if "pos" in signals and len(signals["pos"].time_s) > AROUND:
        signals["pos"], found = _without_jumps(signals["pos"])
        findings += found
        if "vel" in signals and len(signals["vel"].time_s) > AROUND:
            signals["vel"], found = _without_glitches(signals["vel"], signals["pos"])
            findings += found
    return replace(recording, signals=signals), findings


def _kept(samples: Signal, good: np.ndarray) -> Signal:
    return Signal(samples.time_s[good], samples.value[good])


def _leave_repeats(signals: dict[str, Signal]) -> list[Finding]:
    """Remove repeated poses in place, with the signals logged at the same times."""
    for name in ("quat", "pos"):
        samples = signals.get(name)
        if samples is None or len(samples.time_s) <= AROUND:
            continue
        new = np.ones(len(samples.time_s), dtype=bool)
        new[1:] = np.any(samples.value[1:] != samples.value[:-1], axis=1)
        share = float(np.mean(~new))
        if share < REPEATED or _is_coarse(samples) or not _moves(samples):
            continue
        for other in ("pos", "quat", "vel"):
            own = signals.get(other)
            if own is not None and np.array_equal(own.time_s, samples.time_s):
                signals[other] = _kept(own, new)
        text = f"{100 * share:.0f} % of the poses repeat the one before: left out"
        return [Finding("corrected", TEXTS[name], text)]
    return []


def _is_coarse(samples: Signal) -> bool:
    """Return whether changes are a few steps of a coarse scale, as of whole millimetres."""
    change = np.abs(np.diff(samples.value, axis=0))
    change = change[change > 0.0]
    if not len(change):
        return True
    # Rounding makes the smallest change smaller than a step of the scale.
    least = float(np.quantile(change, 0.02))
    return float(np.median(change)) < COARSE * least


def _moves(samples: Signal) -> bool:
    """Return whether nearly every sample differs from that a second later."""
    later = max(1, int(1.0 / max(median_step(samples.time_s), 1e-6)))
    if later >= len(samples.value):
        return False
    return bool(np.mean(np.any(samples.value[later:] != samples.value[:-later], axis=1)) > 0.9)


def _without_filled_in(quat: Signal) -> tuple[Signal, list[Finding]]:
    value = continuous(quat.value / np.linalg.norm(quat.value, axis=1, keepdims=True))
    step = np.diff(quat.time_s)[:, None]
    rate = rotation_vector(multiply(conjugate(value[:-1]), value[1:])) / step
    change = np.linalg.norm(rate[1:] - rate[:-1], axis=1)
    size = np.linalg.norm(rate[1:], axis=1)
    between = np.zeros(len(value), dtype=bool)
    between[1:-1] = (size > TURNING) & (change < EXACT * size)
    share = float(np.mean(between))
    if share < REPEATED:
        return quat, []
    text = f"{100 * share:.0f} % of its samples are interpolated: left out"
    return _kept(quat, ~between), [Finding("corrected", "attitude", text)]


def _without_jumps(pos: Signal) -> tuple[Signal, list[Finding]]:
    half = AROUND // 2
    padded = np.concatenate([pos.value[:1]] * half + [pos.value] + [pos.value[-1:]] * half)
    around = np.lib.stride_tricks.sliding_window_view(padded, AROUND, axis=0)
    reach = half * median_step(pos.time_s)
    far = np.abs(pos.value - np.median(around, axis=-1)).max(axis=1)
    bad = far > POS_LEAST + 0.5 * ACC_MAX * reach**2
    bad[:half] = bad[len(bad) - half :] = False
    if not bad.any():
        return pos, []
    worst = float(far[bad].max())
    text = f"{int(bad.sum())} samples jump by up to {worst:.2g} m and back: left out"
    return _kept(pos, ~bad), [Finding("corrected", "position", text)]


def _without_glitches(vel: Signal, pos: Signal) -> tuple[Signal, list[Finding]]:
    """Remove velocities that contradict the path; a velocity in another frame is kept."""
    path = velocity_from_position(pos.time_s, pos.value)
    slope = np.stack([np.interp(vel.time_s, pos.time_s, column) for column in path.T], axis=1)
    off = vel.value - slope
    usual = 1.4826 * np.median(np.abs(off - np.median(off, axis=0)), axis=0)
    speed = float(np.sqrt(np.mean(np.sum(slope**2, axis=1))))
    if np.linalg.norm(usual) > 0.3 * max(speed, VEL_LEAST):
        return vel, []
    far = np.abs(off - np.median(off, axis=0))
    bad = np.any(far > np.maximum(TIMES_USUAL * usual, VEL_LEAST), axis=1)
    # At the ends and next to gaps the slope uses one side only.
    steps = np.diff(pos.time_s)
    holes = pos.time_s[:-1][steps > 4.0 * median_step(pos.time_s)]
    for edge in (
        pos.time_s[0],
        pos.time_s[-1],
        *holes,
        *pos.time_s[1:][np.isin(pos.time_s[:-1], holes)],
    ):
        bad &= np.abs(vel.time_s - edge) > EDGE_S
    if not bad.any() or np.mean(bad) > 0.1:
        return vel, []
    worst = float(np.linalg.norm(off[bad], axis=1).max())
    text = f"{int(bad.sum())} samples are up to {worst:.2g} m/s off the path's slope: left out"
    return _kept(vel, ~bad), [Finding("corrected", "velocity", text)]

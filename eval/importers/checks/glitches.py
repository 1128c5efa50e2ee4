"""Remove impossible samples from a log: jumps, and samples that were not measured.

Jumps of position and velocity would pass for collisions. Repeated and interpolated samples are not
measurements, and with them the noise seems smaller than it is.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from eval.importers.frames import conjugate, multiply, rotation_vector
from eval.importers.rows import continuous
from eval.importers.signals import MAD_TO_SD, Recording, Signal, median_step
from eval.logs.faults.finding import Finding
from eval.logs.faults.position import ACC_MAX
from eval.logs.faults.relation import rms
from eval.logs.velocity import velocity_from_position

POS_LEAST, VEL_LEAST = 0.02, 0.1
"""Jumps of position [m] and velocity [m/s] up to these sizes are kept."""
GLITCH_SD = 8.0
"""A velocity further from the path's slope than this many standard deviations is a glitch."""
EDGE_S = 0.1
"""Time around a gap or an end of the positions in which velocities are not checked [s]."""
MEDIAN_SAMPLES = 7
"""Number of samples of the running median with which a position is compared."""
REPEATED = 0.02
"""Share of repeated or interpolated samples above which they are removed."""
LOST_S, LOST_HOLDS, LOST_RATE = 0.2, 5.0, 0.3
"""A pose that repeats for longer [s], and for so many times the usual hold, is lost where the gyro
turns faster [rad/s]."""
COARSE = 4.0
"""A signal is coarse if its median change between samples is below this many steps of its
resolution. Repeated samples of a coarse signal may be real."""
TEXTS = {"pos": "position", "quat": "attitude"}
"""Signals and their names in messages."""
TURNING = 0.05
"""Least body rate at which an interpolated attitude can be detected [rad/s]."""
EXACT = 1e-3
"""Largest relative change of the body rate at an attitude that counts as interpolated."""


def clean(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Return the recording (time in s) without impossible samples, and the findings."""
    signals, findings = dict(recording.signals), []
    findings += _drop_repeats(signals)
    if "quat" in signals and len(signals["quat"].time_s) > MEDIAN_SAMPLES:
        signals["quat"], more_findings = _without_interpolated(signals["quat"])
        findings += more_findings
    if "pos" in signals and len(signals["pos"].time_s) > MEDIAN_SAMPLES:
        signals["pos"], more_findings = _without_jumps(signals["pos"])
        findings += more_findings
        if "vel" in signals and len(signals["vel"].time_s) > MEDIAN_SAMPLES:
            signals["vel"], more_findings = _without_glitches(signals["vel"], signals["pos"])
            findings += more_findings
    return replace(recording, signals=signals), findings


def _select(samples: Signal, good: np.ndarray) -> Signal:
    return Signal(samples.time_s[good], samples.value[good])


def _drop_repeats(signals: dict[str, Signal]) -> list[Finding]:
    """Remove repeated poses in place, with the signals logged at the same times."""
    for name in ("quat", "pos"):
        samples = signals.get(name)
        if samples is None or len(samples.time_s) <= MEDIAN_SAMPLES:
            continue
        is_new = np.ones(len(samples.time_s), dtype=bool)
        is_new[1:] = np.any(samples.value[1:] != samples.value[:-1], axis=1)
        share = float(np.mean(~is_new))
        if share < REPEATED or _is_coarse(samples) or not _moves(samples):
            continue
        for other in ("pos", "quat", "vel"):
            samples_of_other = signals.get(other)
            if samples_of_other is not None and np.array_equal(
                samples_of_other.time_s, samples.time_s
            ):
                signals[other] = _select(samples_of_other, is_new)
        text = f"{100 * share:.0f} % of the poses repeat the one before: left out"
        return [Finding("corrected", TEXTS[name], text)]
    return []


def without_lost(recording: Recording) -> tuple[Recording, list[Finding]]:
    """Return the recording without poses that stand still while the gyro turns: tracking is lost.

    On the ground a pose may repeat; without a gyro none counts as lost.
    """
    signals, findings, rate = dict(recording.signals), [], recording.signals.get("rate")
    for name in TEXTS:
        samples = signals.get(name)
        if rate is None or samples is None or len(samples.time_s) <= MEDIAN_SAMPLES:
            continue
        if _is_coarse(samples):
            continue
        time_s, is_lost = samples.time_s, np.zeros(len(samples.time_s), dtype=bool)
        changes = np.flatnonzero(np.diff(samples.value, axis=0).any(axis=1)) + 1
        starts, stops = np.append(0, changes), np.append(changes, len(time_s))
        held_s = time_s[stops - 1] - time_s[starts]
        longest_s = LOST_S + LOST_HOLDS * np.median(held_s)  # a slow signal is held in fast rows
        for first, stop, hold_s in zip(starts, stops, held_s, strict=True):
            if hold_s > longest_s:
                inside = (rate.time_s >= time_s[first]) & (rate.time_s <= time_s[stop - 1])
                is_lost[first + 1 : stop] = inside.any() and rms(rate.value[inside]) > LOST_RATE
        if is_lost.any():
            for other in (name, "vel"):
                if other in signals and np.array_equal(signals[other].time_s, time_s):
                    signals[other] = _select(signals[other], ~is_lost)
            text = f"{is_lost.sum()} samples stand still while the gyro turns (lost): left out"
            findings.append(Finding("corrected", TEXTS[name], text))
    return replace(recording, signals=signals), findings


def _is_coarse(samples: Signal) -> bool:
    """Return whether changes are a few steps of a coarse resolution, such as 1 mm."""
    change = np.abs(np.diff(samples.value, axis=0))
    change = change[change > 0.0]
    if not len(change):
        return True
    # A low quantile, because rounding makes the very smallest change smaller than a step.
    resolution_step = float(np.quantile(change, 0.02))
    return float(np.median(change)) < COARSE * resolution_step


def _moves(samples: Signal) -> bool:
    """Return whether nearly every sample differs from the sample a second later."""
    later = max(1, int(1.0 / max(median_step(samples.time_s), 1e-6)))
    if later >= len(samples.value):
        return False
    return bool(np.mean(np.any(samples.value[later:] != samples.value[:-later], axis=1)) > 0.9)


def _without_interpolated(quat: Signal) -> tuple[Signal, list[Finding]]:
    """Remove attitudes at which the body rate does not change: these were interpolated."""
    value = continuous(quat.value / np.linalg.norm(quat.value, axis=1, keepdims=True))
    step = np.diff(quat.time_s)[:, None]
    rate = rotation_vector(multiply(conjugate(value[:-1]), value[1:])) / step
    change = np.linalg.norm(rate[1:] - rate[:-1], axis=1)
    rate_size = np.linalg.norm(rate[1:], axis=1)
    is_interpolated = np.zeros(len(value), dtype=bool)
    is_interpolated[1:-1] = (rate_size > TURNING) & (change < EXACT * rate_size)
    share = float(np.mean(is_interpolated))
    if share < REPEATED:
        return quat, []
    text = f"{100 * share:.0f} % of its samples are interpolated: left out"
    return _select(quat, ~is_interpolated), [Finding("corrected", "attitude", text)]


def _without_jumps(pos: Signal) -> tuple[Signal, list[Finding]]:
    """Remove positions further from the running median than the largest acceleration allows."""
    half = MEDIAN_SAMPLES // 2
    padded = np.concatenate([pos.value[:1]] * half + [pos.value] + [pos.value[-1:]] * half)
    windows = np.lib.stride_tricks.sliding_window_view(padded, MEDIAN_SAMPLES, axis=0)
    reach_s = half * median_step(pos.time_s)
    jump_m = np.abs(pos.value - np.median(windows, axis=-1)).max(axis=1)
    bad = jump_m > POS_LEAST + 0.5 * ACC_MAX * reach_s**2
    bad[:half] = bad[len(bad) - half :] = False  # the padded median is no reference at the ends
    if not bad.any():
        return pos, []
    worst = float(jump_m[bad].max())
    text = f"{int(bad.sum())} samples jump by up to {worst:.2g} m and back: left out"
    return _select(pos, ~bad), [Finding("corrected", "position", text)]


def _without_glitches(vel: Signal, pos: Signal) -> tuple[Signal, list[Finding]]:
    """Remove velocities that contradict the path; a velocity in another frame is kept."""
    path = velocity_from_position(pos.time_s, pos.value)
    slope = np.stack([np.interp(vel.time_s, pos.time_s, column) for column in path.T], axis=1)
    error = vel.value - slope
    deviation = np.abs(error - np.nanmedian(error, axis=0))  # no slope at a lone position
    error_sd = MAD_TO_SD * np.nanmedian(deviation, axis=0)
    speed = float(np.sqrt(np.nanmean(np.sum(slope**2, axis=1))))
    if np.linalg.norm(error_sd) > 0.3 * max(speed, VEL_LEAST):
        return vel, []
    bad = np.any(deviation > np.maximum(GLITCH_SD * error_sd, VEL_LEAST), axis=1)
    # At the ends and next to gaps the slope uses positions on one side only.
    gaps = np.diff(pos.time_s) > 4.0 * median_step(pos.time_s)
    ends = pos.time_s[[0, -1]]
    for edge in (*ends, *pos.time_s[:-1][gaps], *pos.time_s[1:][gaps]):
        bad &= np.abs(vel.time_s - edge) > EDGE_S
    if not bad.any() or np.mean(bad) > 0.1:
        return vel, []
    worst = float(np.linalg.norm(error[bad], axis=1).max())
    text = f"{int(bad.sum())} samples are up to {worst:.2g} m/s off the path's slope: left out"
    return _select(vel, ~bad), [Finding("corrected", "velocity", text)]

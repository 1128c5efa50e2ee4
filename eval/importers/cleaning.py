"""Clean a recording: impossible samples, the delay of its pose, and its time on the ground.

Jumps of position and velocity would pass for collisions. Repeated and interpolated samples are not
measurements, and with them the noise seems smaller than it is.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from eval.importers.frames import rates_between
from eval.importers.rows import continuous
from eval.importers.signals import KEPT, MAD_TO_SD, Recording, Signal, median_step
from eval.logs.faults.clocks.delay import LATE_S, LEAST_S, OF_POSE, SURE, delay_of
from eval.logs.faults.clocks.rotation import rotation_findings
from eval.logs.faults.clocks.stamps import MEASURED, even_stamps, finding_of, measured_in
from eval.logs.faults.drive.commands import has_both_signs
from eval.logs.faults.finding import Finding
from eval.logs.faults.position import MEDIAN_SAMPLES, jumps_of
from eval.logs.faults.relation import interpolate
from eval.logs.faults.sensors import is_coarse, lost_samples
from eval.logs.velocity import velocity_from_position

VEL_LEAST = 0.1
"""Jumps of a velocity up to this size are kept [m/s]."""
GLITCH_SD = 8.0
"""A velocity further from the path's slope than this many standard deviations is a glitch."""
EDGE_S = 0.1
"""Time around a gap or an end of the positions in which velocities are not checked [s]."""
REPEATED = 0.02
"""Share of repeated or interpolated samples above which they are removed."""
TEXTS = {"pos": "position", "quat": "attitude"}
"""Signals and their names in messages."""
TURNING = 0.05
"""Least body rate at which an interpolated attitude can be detected [rad/s]."""
EXACT = 1e-3
"""Largest relative change of the body rate at an attitude that counts as interpolated."""
RUNNING = 0.5
"""The motors carry the vehicle if their effort exceeds this share of its median in flight."""
HOLD_S = 0.3
"""Least duration of a flight: time above `RUNNING` without a break [s]."""
RISE_M = 0.05
"""Height above the ground from which the vehicle counts as flying [m]."""
POWER = {
    **{"throttle": 1, "cmd_thrust": 1, "kept:cmd_force": 1, "kept:thrust_share": 1},
    **{"pwm": 1, "motor": 2, "motor_cmd": 2},
}
"""Signals that measure the motors' effort -> exponent with which each gives the thrust."""
Found = tuple[np.ndarray, str] | None
"""Which samples of a signal (N,) bool to leave out, and why; None for none."""


def clean(recording: Recording) -> Recording:
    """Return the recording (time in s) without impossible samples."""
    signals = dict(recording.signals)
    for names, subject, find in (
        (("quat",), "attitude", _interpolated),
        (("pos",), "position", _jumps),
        (("vel", "pos"), "velocity", _glitches),
    ):
        samples = [signals[name] for name in names if _is_long(recording, name)]
        found = find(*samples) if len(samples) == len(names) else None
        if found is not None:
            is_bad, text = found
            signals[names[0]] = _select(samples[0], ~is_bad)
            recording = recording.noting(Finding("corrected", subject, f"{text}: left out"))
    return replace(recording, signals=signals)


def _is_long(recording: Recording, name: str) -> bool:
    """Return whether a recording has a signal, with enough samples to clean it."""
    return name in recording.signals and len(recording.signals[name].time_s) > MEDIAN_SAMPLES


def _select(samples: Signal, good: np.ndarray) -> Signal:
    return Signal(samples.time_s[good], samples.value[good])


def _keep(
    signals: dict[str, Signal], names: Collection[str], like: Signal, good: np.ndarray
) -> None:
    """Keep the `good` samples of the signals logged at the times of `like`, in place."""
    for name in names:
        if name in signals and np.array_equal(signals[name].time_s, like.time_s):
            signals[name] = _select(signals[name], good)


def check_evenness(recording: Recording, fix: bool) -> Recording:
    """Return the recording with jittery stamps spaced evenly if `fix`, and with the findings."""
    signals, findings, tested = dict(recording.signals), [], set[str]()
    for name, (time_s, _) in recording.signals.items():
        if name not in MEASURED or name in tested:
            continue
        together = [n for n, s in signals.items() if np.array_equal(s.time_s, time_s)]
        tested.update(together)
        values = {n: signals[n].value for n in together}
        even_s = even_stamps(time_s, measured_in(values))
        if even_s is None:
            continue
        todo = "" if fix else "leave --no-fix out: the import spaces them evenly"
        names = ", ".join(n for n in together if not n.startswith(KEPT))
        findings.append(finding_of(time_s, even_s, names, todo))
        signals |= {n: Signal(even_s, value) for n, value in values.items()}
    return (replace(recording, signals=signals) if fix else recording).noting(*findings)


def without_repeats(recording: Recording) -> Recording:
    """Return the recording without repeated poses, and the signals logged at the same times."""
    signals = dict(recording.signals)
    for name in ("quat", "pos"):
        if not _is_long(recording, name):
            continue
        samples = signals[name]
        is_new = np.ones(len(samples.time_s), dtype=bool)
        is_new[1:] = np.any(samples.value[1:] != samples.value[:-1], axis=1)
        share = float(np.mean(~is_new))
        if share < REPEATED or is_coarse(samples.value) or not _moves(samples):
            continue
        _keep(signals, OF_POSE, samples, is_new)
        text = f"{100 * share:.0f} % of the poses repeat the one before: left out"
        recording = recording.noting(Finding("corrected", TEXTS[name], text))
    return replace(recording, signals=signals)


def without_far(recording: Recording) -> Recording:
    """Return the recording, in any unit, without positions that jump far: they hide its faults."""
    signals = dict(recording.signals)
    if "pos" in signals:
        pos = signals["pos"]
        signals["pos"] = _select(pos, jumps_of(*pos, in_metres=False) == 0.0)
    return replace(recording, signals=signals)


def without_lost(recording: Recording) -> Recording:
    """Return the recording without poses that stand still while the gyro turns (tracking lost)."""
    signals, rate = dict(recording.signals), recording.signals.get("rate")
    for name in TEXTS:
        if rate is None or not _is_long(recording, name):
            continue
        samples = signals[name]
        is_lost = lost_samples(*samples, *rate)
        if is_lost[1:].all():
            continue  # nothing would be left: `check_still` reports it
        if is_lost.any():
            _keep(signals, (name, "vel"), samples, ~is_lost)
            text = f"{is_lost.sum()} samples stand still while the gyro turns (lost): left out"
            recording = recording.noting(Finding("corrected", TEXTS[name], text))
    return replace(recording, signals=signals)


def _moves(samples: Signal) -> bool:
    """Return whether nearly every sample differs from the sample a second later."""
    later = max(1, int(1.0 / max(median_step(samples.time_s), 1e-6)))
    if later >= len(samples.value):
        return False
    return bool(np.mean(np.any(samples.value[later:] != samples.value[:-later], axis=1)) > 0.9)


def _interpolated(quat: Signal) -> Found:
    """Return attitudes at which the body rate does not change: these were interpolated."""
    value = continuous(quat.value / np.linalg.norm(quat.value, axis=1, keepdims=True))
    _, rate = rates_between(quat.time_s, value, 1)
    change = np.linalg.norm(rate[1:] - rate[:-1], axis=1)
    rate_size = np.linalg.norm(rate[1:], axis=1)
    is_interpolated = np.zeros(len(value), dtype=bool)
    is_interpolated[1:-1] = (rate_size > TURNING) & (change < EXACT * rate_size)
    share = float(np.mean(is_interpolated))
    if share < REPEATED:
        return None
    return is_interpolated, f"{100 * share:.0f} % of its samples are interpolated"


def _jumps(pos: Signal) -> Found:
    """Return positions further from their neighbours than the largest acceleration allows."""
    jump_m = jumps_of(*pos, in_metres=True)
    bad, worst = jump_m > 0.0, float(jump_m.max())
    return (bad, f"{bad.sum()} samples jump by up to {worst:.2g} m and back") if worst else None


def _glitches(vel: Signal, pos: Signal) -> Found:
    """Return velocities that contradict the path; a velocity in another frame is kept."""
    path = velocity_from_position(pos.time_s, pos.value)
    slope = interpolate(vel.time_s, pos.time_s, path)
    error = vel.value - slope
    deviation = np.abs(error - np.nanmedian(error, axis=0))  # no slope at a lone position
    error_sd = MAD_TO_SD * np.nanmedian(deviation, axis=0)
    speed = float(np.sqrt(np.nanmean(np.sum(slope**2, axis=1))))
    if np.linalg.norm(error_sd) > 0.3 * max(speed, VEL_LEAST):
        return None
    bad = np.any(deviation > np.maximum(GLITCH_SD * error_sd, VEL_LEAST), axis=1)
    # At the ends and next to gaps the slope uses positions on one side only.
    gaps = np.diff(pos.time_s) > 4.0 * median_step(pos.time_s)
    ends = pos.time_s[[0, -1]]
    for edge in (*ends, *pos.time_s[:-1][gaps], *pos.time_s[1:][gaps]):
        bad &= np.abs(vel.time_s - edge) > EDGE_S
    if not bad.any() or np.mean(bad) > 0.1:
        return None
    worst = float(np.linalg.norm(error[bad], axis=1).max())
    return bad, f"{bad.sum()} samples are up to {worst:.2g} m/s off the path's slope"


def check_delay(recording: Recording, fix: bool) -> Recording:
    """Return the recording with pose and gyro shifted to one clock, and findings on their delay.

    The recording has times in s, rates in rad/s and a flight log's frames; it must have quat and
    rate. Without `fix` the delay is only reported.
    """
    quat, rate = recording.signals["quat"], recording.signals["rate"]
    fit = delay_of(quat.time_s, quat.value, rate.time_s, rate.value)
    if fit is None:
        return recording
    delay, findings = fit.delay_s, rotation_findings(fit.rotation)
    is_late = not fit.jump_s and abs(delay) > max(LEAST_S, SURE * fit.error_s)
    moved = fit.moved(recording.signals) if is_late else OF_POSE
    subject, figures = fit.figures(moved)
    option = "leave --no-fix out: the import shifts it"
    status = "corrected" if fix else "doubt"
    findings += fit.drift_findings(status, option)
    if is_late:
        confidence = 0.95 if abs(delay) > LATE_S else 0.8
        what = {"rate": "it is", "acc": "it and the accelerometer are"}.get(
            moved[-1], "pose and velocity are"
        )
        text = f"{figures}: {what} shifted" if fix else f"{figures}; not corrected"
        about = ("clock_offset", delay, confidence, option)
        findings.append(Finding(status, subject, text, *about))
    elif not fit.jump_s:
        findings.append(Finding("ok", subject, figures))
    recording = recording.noting(*findings)
    drift = fit.drift if fit.drifts else 0.0
    if not fix or not (is_late or drift):
        return recording
    signals = dict(recording.signals)
    for name in {*OF_POSE, *moved} & signals.keys():
        time_s, value = signals[name]
        if name in OF_POSE:
            time_s = time_s - drift * (time_s - fit.middle_s)
        if name in moved:
            time_s = time_s - (delay if name in OF_POSE else -delay)
        signals[name] = Signal(time_s, value)
    return replace(recording, signals=signals)


def airborne(recording: Recording) -> tuple[tuple[float, float], list[Finding]]:
    """Return the first and the last time in flight [s], infinite where unknown, and a finding."""
    no_limits = (-np.inf, np.inf)
    effort = _motor_effort(recording)
    if effort is None:
        text = "no signal shows when the motors run: nothing is cut; see --start and --end"
        return no_limits, [Finding("note", "ground", text)]
    time_s = effort.time_s
    in_flight = _long_runs(time_s, effort.value[:, 0] > RUNNING)
    if not in_flight.any():
        text = f"the motors never run for {HOLD_S:g} s: nothing is cut"
        return no_limits, [Finding("doubt", "ground", text)]
    first, last = np.flatnonzero(in_flight)[[0, -1]]
    start = float(time_s[first]) if time_s[first] > time_s[0] else -np.inf
    stop = float(time_s[last]) if time_s[last] < time_s[-1] else np.inf
    if "pos" in recording.signals:
        start, stop = _off_ground(recording.signals["pos"], start, stop)
    if not np.isfinite(start) and not np.isfinite(stop):
        return no_limits, [Finding("ok", "ground", "it flies from the first row to the last")]
    cuts = []
    if np.isfinite(start):
        cuts.append(f"the {start - time_s[0]:.1f} s before take-off")
    if np.isfinite(stop):
        cuts.append(f"the {time_s[-1] - stop:.1f} s after landing")
    text = f"{' and '.join(cuts)} are left out"
    return (float(start), float(stop)), [Finding("note", "ground", text)]


def _motor_effort(recording: Recording) -> Signal | None:
    """Return the motors' thrust relative to its median in flight; None without such a signal."""
    for name, power in POWER.items():
        samples = recording.signals.get(name)
        if samples is None or len(samples.time_s) < 10:
            continue
        thrust_level = np.mean(samples.value**power, axis=1)  # speeds may have the spin's sign
        if has_both_signs(thrust_level):
            continue
        high_level = float(np.quantile(thrust_level, 0.95))
        if high_level <= 0.0:
            continue
        median_in_flight = float(np.median(thrust_level[thrust_level > RUNNING * high_level]))
        return Signal(samples.time_s, (thrust_level / median_in_flight)[:, None])
    return None


def _long_runs(time_s: np.ndarray, running: np.ndarray) -> np.ndarray:
    """Return which samples belong to a run of at least `HOLD_S`."""
    edges = np.flatnonzero(np.diff(running.astype(int))) + 1
    in_long_run = np.zeros(len(running), dtype=bool)
    for run in np.split(np.arange(len(running)), edges):
        if running[run[0]] and time_s[run[-1]] - time_s[run[0]] >= HOLD_S:
            in_long_run[run] = True
    return in_long_run


def _off_ground(pos: Signal, start: float, stop: float) -> tuple[float, float]:
    """Return the first and last time [s] within `start` and `stop` above the ground.

    The ground is the median height over the second before the start and after the stop.
    """
    time_s, height = pos.time_s, pos.value[:, 2]
    is_inside = (time_s >= start) & (time_s <= stop)
    if not is_inside.any():
        return start, stop
    before = (time_s < start) & (time_s > start - 1.0)
    after = (time_s > stop) & (time_s < stop + 1.0)
    ends = [start, stop]
    for k, near in ((0, before), (-1, after)):
        ground = float(np.median(height[near])) if near.any() else float(height[is_inside][k])
        above_ground = time_s[is_inside & (height > ground + RISE_M)]
        if np.isfinite(ends[k]) and len(above_ground):
            ends[k] = float(above_ground[k])
    return ends[0], ends[1]

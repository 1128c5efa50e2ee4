"""Position and attitude from another device, brought onto the log's clock.

The clocks of motion capture and flight controller have an unknown offset, and their rates differ by
some 10 ppm. The body rates from the pose are aligned with the gyro's. The first step compares their
magnitudes over the whole flight, which do not depend on frames. The second step estimates offset,
drift, gyro bias and the rotation between the two body frames together, by least squares
(Gauss-Newton; the rotation by Kabsch 1976).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from eval.importers.formats.table import read_table
from eval.importers.frames import conjugate, multiply, rotation_vector
from eval.importers.options import ImportOptions
from eval.importers.rows import averaged, continuous, row_times, rows_at
from eval.importers.signals import Recording, Signal, median_step
from eval.logs.columns import FlightLogError
from eval.logs.faults.finding import Finding
from eval.logs.faults.pose import GOOD, TIMES_BETTER, fit_pose_readings
from eval.logs.faults.reading import TIMES, read_as
from eval.logs.files import MOST_ROWS
from tracks.geometry.rotation import rot_to_quat

FIRST_REACH_S = 15.0
"""Time on both sides of the middle with which the fit begins [s]."""
COARSE_HZ = 100.0
"""Largest row rate for the checks of the path."""
GRID_S = 0.005
"""Step of the cross-correlation [s]."""
SPAN_S = 0.025
"""Time over which the pose is differenced and the gyro averaged [s]."""
OVERLAP_S = 3.0
"""Least common duration of the two recordings [s]."""
ALIKE = 0.6
"""Correlation of the rates below which the clocks count as not aligned."""
SURE = 0.9
"""Correlation above which no other reading of the quaternion is tried."""
READINGS = {
    "xyzw": "xyzw",
    "inverse": "world to body",
    "xyzw+inverse": "xyzw and world to body",
}
"""Other readings of the attitude: steps of `read_as` -> description."""
SIGNS = ("-roll", "-pitch", "-yaw")
"""Readings with one wrong sign. Clocks are aligned with them and a mirrored gyro; later checks
decide which signal is wrong (`eval/logs/faults/pose.py`, `vectors.py`)."""
USUAL_STEP_S = 1.0 / 150.0
"""Usual time between poses of cameras and trackers, 30 to 1000 a second."""
LONG_S = 7200.0
"""Longest recording that is aligned; longer ones have a wrong unit of time or a jump [s]."""
DRIFT_MAX = 2e-3
"""Largest plausible relative drift of two clocks."""
DRIFT = 2e-4
"""Largest relative drift of two crystals."""
TURN_DEG = 15.0
"""Rotation between the body frames above which it is corrected; a smaller one may be a tilt."""


@dataclass(frozen=True)
class Alignment:
    """Relation of the pose's clock and body frame to the log's."""

    offset_s: float
    """Log time of the pose's time 0 [s]."""
    drift: float
    """Log seconds per pose second, less 1."""
    turn: np.ndarray
    """(3, 3) rotation from the pose's body axes to the gyro's."""
    correlation: float
    """Of the rates after the alignment."""
    offset_sd_s: float
    """Standard error of the offset in the middle of the flight [s]."""
    drift_sd: float
    """Standard error of the drift."""

    @property
    def turn_deg(self) -> float:
        """Angle of `turn` [deg]."""
        return float(np.rad2deg(np.linalg.norm(_vector(self.turn))))


def with_pose(
    recording: Recording, options: ImportOptions
) -> tuple[Recording, tuple[Finding, ...]]:
    """Return `recording` with position and attitude of the file `options.pose`, and findings.

    Raises:
        FlightLogError: where the files cannot be aligned, or the pose holds no position or
            attitude.
        ValueError: for a mapping file that cannot be used.
    """
    assert options.pose is not None
    pose = read_table(options.pose, options.pose_map, options)
    for name, text in (("pos", "position"), ("quat", "attitude")):
        if name not in pose.signals:
            reason = f"holds no {text}; name its columns with --pose-map"
            raise FlightLogError(str(options.pose), None, None, reason)
    if "rate" not in recording.signals:
        raise FlightLogError(recording.name, None, None, "holds no gyro to align a pose with")
    pose, unit = _in_seconds(pose)
    quat, alignment, reading = _best_reading(pose, recording, options.fix)
    turn_deg = alignment.turn_deg
    text = (
        f"its clock is {alignment.offset_s:+.4f} s (± {1e3 * alignment.offset_sd_s:.2g} ms) "
        f"from the log's and runs {1e6 * alignment.drift:+.0f} ppm off; "
        f"rates correlate by {alignment.correlation:.3f}"
    )
    findings = [*pose.findings, *unit, Finding("ok", "pose clock", text), *reading]
    if abs(alignment.drift) > max(DRIFT, 4.0 * alignment.drift_sd):
        text = (
            f"its clock runs {1e6 * alignment.drift:+.0f} ppm (± {1e6 * alignment.drift_sd:.0f}) "
            "off the log's, more than two crystals do: the pose is moved by that"
        )
        about = ("clock_drift", alignment.drift, 0.95)
        findings.append(Finding("corrected", "pose clock", text, *about))
    if turn_deg > TURN_DEG and not _has_a_sign(_moved(recording, pose, quat, alignment)):
        axis = ", ".join(f"{v:+.2f}" for v in _vector(alignment.turn) / np.deg2rad(turn_deg))
        text = f"its body is turned by {turn_deg:.1f} deg about ({axis}) against the gyro"
        if options.fix:
            change = conjugate(rot_to_quat(alignment.turn))
            quat = Signal(quat.time_s, multiply(quat.value, np.broadcast_to(change, (1, 4))))
        level = "corrected" if options.fix else "doubt"
        findings.append(Finding(level, "pose axes", text, "body_frame", None, 0.9))
    elif turn_deg > 1.0:
        text = f"its body is turned by {turn_deg:.1f} deg against the gyro; left as it is"
        findings.append(Finding("note", "pose axes", text))
    return _moved(recording, pose, quat, alignment), tuple(findings)


def _moved(recording: Recording, pose: Recording, quat: Signal, alignment: Alignment) -> Recording:
    """Return `recording` with the pose, its attitude `quat`, on the recording's clock."""
    signals = dict(recording.signals)
    for name, samples in {**pose.signals, "quat": quat}.items():
        if name in ("pos", "quat", "vel"):
            time_s = alignment.offset_s + (1.0 + alignment.drift) * samples.time_s
            signals[name] = Signal(time_s, samples.value)
    return replace(recording, signals=signals)


def _has_a_sign(recording: Recording) -> bool:
    """Return whether the path shows that an angle has the wrong sign."""
    times = row_times(recording, COARSE_HZ, 0.0, None)
    fits = fit_pose_readings({k: v for k, v in rows_at(recording, times).items() if k != "rate"})
    if fits is None or fits.given.force is None or fits.best.force is None:
        return False
    better = fits.best.force < GOOD and fits.given.force > TIMES_BETTER * fits.best.force
    return better and fits.best.quat in SIGNS


def _in_seconds(pose: Recording) -> tuple[Recording, list[Finding]]:
    """Return the pose with its time in seconds, in the unit that gives a usual camera rate."""
    step = median_step(pose.signals["quat"].time_s)
    unit = min(TIMES, key=lambda name: abs(np.log(step * TIMES[name] / USUAL_STEP_S)))
    if unit == "s":
        return pose, []
    scaled = {n: Signal(s.time_s * TIMES[unit], s.value) for n, s in pose.signals.items()}
    text = f"rows are {step:.4g} apart, so time is in {unit}"
    return replace(pose, signals=scaled), [Finding("corrected", "pose time", text, "time_unit")]


def _best_reading(
    pose: Recording, recording: Recording, fix: bool
) -> tuple[Signal, Alignment, list[Finding]]:
    """Return the attitude in the reading whose body rates agree with the gyro."""
    quat, rate = pose.signals["quat"], recording.signals["rate"]
    given = align(quat, rate, pose.name)
    enough = max(SURE, 0.5 + 0.5 * given.correlation)
    if given.correlation > SURE and given.turn_deg <= TURN_DEG:
        return quat, given, []
    found = {
        steps: align(Signal(quat.time_s, read_as("quat", quat.value, steps)), rate, pose.name)
        for steps in (*READINGS, *SIGNS)
    }
    # Among readings with equal correlation, prefer a body frame close to the gyro's.
    best = max(found, key=lambda steps: found[steps].correlation + 0.1 * found[steps].turn.trace())
    if fix and best in READINGS and found[best].correlation > enough:
        fault = "quaternion_order" if "xyzw" in best else "quaternion_direction"
        text = f"it turns as the gyro does only if it is {READINGS[best]}"
        about = (fault, None, found[best].correlation)
        read = Signal(quat.time_s, read_as("quat", quat.value, best))
        return read, found[best], [Finding("corrected", "pose attitude", text, *about)]
    mirrored = align(quat, rate, pose.name, mirrored=True)
    signed = max((mirrored, *(found[s] for s in SIGNS)), key=lambda one: one.correlation)
    if signed.correlation > enough:
        return quat, replace(signed, turn=np.eye(3)), []
    if given.correlation < ALIKE or abs(given.drift) > DRIFT_MAX:
        reason = (
            f"its clock cannot be aligned with the log's: at best the body rates correlate by "
            f"{given.correlation:.2f} (drift {1e6 * given.drift:.0f} ppm). Are both of the same "
            "flight, is time in seconds, and does the body turn enough?"
        )
        raise FlightLogError(pose.name, None, None, reason)
    return quat, given, []


def align(quat: Signal, rate: Signal, name: str, mirrored: bool = False) -> Alignment:
    """Return the alignment of the attitude `quat` with the gyro `rate`.

    Args:
        quat: body to world, on the pose's clock.
        rate: of the gyro, on the log's clock.
        name: of the pose's file, for messages.
        mirrored: allow one inverted axis of the gyro.

    Raises:
        FlightLogError: where either is too short or too coarse.
    """
    centre_s, by_pose = _pose_rates(quat)
    if len(centre_s) < 50:
        raise FlightLogError(name, None, None, "too few poses to align the clocks by")
    for samples in (quat, rate):
        if samples.time_s[-1] - samples.time_s[0] > LONG_S:
            reason = f"lasts more than {LONG_S:g} s; name its unit of time, or cut it"
            raise FlightLogError(name, "time", None, reason)
    offset = _coarse(centre_s, by_pose, rate, name)
    shared = (centre_s + offset > rate.time_s[0]) & (centre_s + offset < rate.time_s[-1])
    middle = float(np.mean(centre_s[shared]))
    result = _Fit(offset, 0.0, np.eye(3), 0.0, np.inf, np.inf)
    reach, whole = FIRST_REACH_S, float(np.max(np.abs(centre_s - middle)))
    # From the middle outwards, because over a long flight the drift is too large for one step.
    while True:
        near = np.abs(centre_s - middle) <= reach
        for _ in range(20):
            result, change = _refine(centre_s[near], by_pose[near], rate, middle, result, mirrored)
            if np.all(np.abs(change) < [1e-7, 1e-9]):
                break
        if reach >= whole:
            break
        reach *= 2.0
    start = result.offset - result.drift * middle
    return Alignment(
        start, result.drift, result.turn, result.correlation, result.sd, result.drift_sd
    )


class _Fit(NamedTuple):
    offset: float
    """Log time less pose time in the middle [s]."""
    drift: float
    turn: np.ndarray
    correlation: float
    sd: float
    drift_sd: float


def _refine(
    centre_s: np.ndarray,
    by_pose: np.ndarray,
    rate: Signal,
    middle: float,
    fit: _Fit,
    mirrored: bool,
) -> tuple[_Fit, np.ndarray]:
    """Return the result of one Gauss-Newton step from `fit`, and the change of offset and drift."""
    at = centre_s + fit.offset + fit.drift * (centre_s - middle)
    inside = (at > rate.time_s[0] + SPAN_S) & (at < rate.time_s[-1] - SPAN_S)
    if np.sum(inside) < 50:
        return fit, np.zeros(2)
    at, seen, since = at[inside], by_pose[inside], (centre_s - middle)[inside, None]
    gyro = averaged(rate.time_s, rate.value, at, SPAN_S)
    step = 0.5 * SPAN_S  # the slope of a shorter piece is mostly noise
    later = averaged(rate.time_s, rate.value, at + step, SPAN_S)
    sooner = averaged(rate.time_s, rate.value, at - step, SPAN_S)
    slope = (later - sooner) / (2.0 * step)
    turn = _kabsch(seen - seen.mean(0), gyro - gyro.mean(0), mirrored)
    turned = seen @ turn.T
    # The scale is free: `faults/vectors.py` finds a gyro in other units.
    centred = turned - turned.mean(0)
    size = float(np.sum(gyro * centred) / max(np.sum(centred**2), 1e-12))
    rest = gyro - size * turned
    # rest = bias + slope * (error of the offset + error of the drift * since)
    columns = [slope.ravel(), (slope * since).ravel()]
    columns += [np.tile(axis, len(seen)) for axis in np.eye(3)]
    design = np.stack(columns, axis=1)
    weight = _robust(rest)
    normal = design.T @ (design * weight[:, None])
    solution = np.linalg.lstsq(normal, design.T @ (weight * rest.ravel()), rcond=None)[0]
    change = np.clip(solution[:2], [-0.05, -1e-3], [0.05, 1e-3])
    noise = float(np.mean(weight * (rest.ravel() - design @ solution) ** 2))
    # Neighbouring differences share samples, which reduces the number of independent ones.
    shared = max(1.0, SPAN_S / median_step(centre_s))
    sd, drift_sd = np.sqrt(shared * noise / np.maximum(np.diag(normal)[:2], 1e-12)).tolist()
    alike = _alike(gyro, seen @ turn.T)
    return _Fit(fit.offset - change[0], fit.drift - change[1], turn, alike, sd, drift_sd), change


def _pose_rates(quat: Signal) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles (K,) [s] of short times and the mean body rates (K, 3) over them."""
    value = continuous(quat.value / np.linalg.norm(quat.value, axis=1, keepdims=True))
    step = median_step(quat.time_s)
    count = max(1, round(SPAN_S / step))
    duration = quat.time_s[count:] - quat.time_s[:-count]
    good = duration < 1.5 * count * step
    relative = multiply(conjugate(value[:-count]), value[count:])
    rates = rotation_vector(relative) / duration[:, None]
    return (0.5 * (quat.time_s[count:] + quat.time_s[:-count]))[good], rates[good]


def grid(time_s: np.ndarray, name: str) -> np.ndarray:
    """Return the grid of the cross-correlation from the first to the last time [s].

    Raises:
        FlightLogError: where it would be longer than any flight.
    """
    span, most = time_s[-1] - time_s[0], MOST_ROWS * GRID_S
    if span > most:
        reason = (
            f"lasts {span:.4g} s, allowed are {most:g} s to align clocks by: is its clock damaged?"
        )
        raise FlightLogError(name, "time", None, reason)
    return np.arange(time_s[0], time_s[-1], GRID_S)


def _coarse(centre_s: np.ndarray, by_pose: np.ndarray, rate: Signal, name: str) -> float:
    """Return log time less pose time by the cross-correlation of the rates' magnitudes [s]."""
    pose_grid, log_grid = grid(centre_s, name), grid(rate.time_s, name)
    least = int(OVERLAP_S / GRID_S)
    if min(len(pose_grid), len(log_grid)) < least:
        raise FlightLogError(name, None, None, f"less than {OVERLAP_S:g} s to align clocks by")
    pose = np.interp(pose_grid, centre_s, np.linalg.norm(by_pose, axis=1))
    # The mean of the vector before its magnitude: noise does not average out of magnitudes.
    log = np.linalg.norm(averaged(rate.time_s, rate.value, log_grid, SPAN_S), axis=1)
    pose, log = pose - pose.mean(), log - log.mean()
    size = 1 << int(np.ceil(np.log2(len(pose) + len(log))))

    def correlate(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return np.fft.irfft(np.fft.rfft(first, size) * np.conj(np.fft.rfft(second, size)), size)

    product = correlate(log, pose)
    energy = np.sqrt(
        np.clip(correlate(log**2, np.ones(len(pose))), 1e-9, None)
        * np.clip(correlate(np.ones(len(log)), pose**2), 1e-9, None)
    )
    shared = correlate(np.ones(len(log)), np.ones(len(pose)))
    # A short overlap is alike by chance more easily: it must be that much better.
    trust = np.sqrt(np.clip(shared / min(len(pose), len(log)), 0.0, 1.0))
    score = np.where(shared > least, product / energy * trust, -1.0)
    lag = int(np.argmax(score))
    lag = lag - size if lag > size // 2 else lag
    return float(log_grid[0] - pose_grid[0] + lag * GRID_S)


def _kabsch(source: np.ndarray, target: np.ndarray, mirrored: bool) -> np.ndarray:
    """Return the rotation (3, 3), or reflection, from `source` (K, 3) to `target`."""
    u, s, vt = np.linalg.svd(target.T @ source)
    if s[1] < 1e-3 * s[0]:
        return np.eye(3)  # rotation about one axis only does not determine the frames
    sign = np.sign(np.linalg.det(u @ vt)) * (-1.0 if mirrored else 1.0)
    return u @ np.diag([1.0, 1.0, sign]) @ vt


def _robust(rest: np.ndarray) -> np.ndarray:
    """Return Huber's weights for residuals (K, 3), one for each number."""
    size = np.linalg.norm(rest - np.median(rest, axis=0), axis=1)
    limit = 2.5 * max(float(np.median(size)), 1e-9)
    return np.repeat(np.minimum(1.0, limit / np.maximum(size, 1e-12)), 3)


def _alike(first: np.ndarray, second: np.ndarray) -> float:
    first, second = first - first.mean(0), second - second.mean(0)
    size = np.sqrt(np.sum(first**2) * np.sum(second**2))
    return float(np.sum(first * second) / size) if size > 0 else 0.0


def _vector(turn: np.ndarray) -> np.ndarray:
    return rotation_vector(rot_to_quat(turn))

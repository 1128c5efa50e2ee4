"""Add position and attitude from another device (motion capture) to a log, on the log's clock.

The clocks of motion capture and flight controller have an unknown offset, and their rates differ by
some 10 ppm. Both are estimated by aligning the body rates from the pose with the gyro's. The first
step correlates their magnitudes over the whole flight, which do not depend on frames. The second
step estimates offset, drift, gyro bias and the rotation between the two body frames together, by
least squares (Gauss-Newton; the rotation by Kabsch 1976).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from eval.importers.formats import table
from eval.importers.frames import conjugate, multiply, rates_between, rotation_vector
from eval.importers.options import ImportOptions
from eval.importers.rows import averaged, continuous, row_times, rows_at
from eval.importers.signals import Recording, Signal, median_step, with_readings
from eval.logs.columns import FlightLogError
from eval.logs.faults.clocks.delay import OF_POSE
from eval.logs.faults.finding import Finding
from eval.logs.faults.pose import GOOD, TIMES_BETTER, fit_pose_readings
from eval.logs.faults.reading import ANGLES, TIMES, read_as
from tracks.geometry.rotation import rot_to_quat

FIRST_REACH_S = 15.0
"""The fit first uses only the samples within this time of the middle of the flight [s]."""
GRID_S = 0.005
"""Step of the cross-correlation [s]."""
SPAN_S = 0.025
"""Time over which the pose is differenced and the gyro averaged [s]."""
OVERLAP_S = 3.0
"""Least common duration of the two recordings [s]."""
MIN_SAMPLES = 50
"""Least number of body rates from the pose for an alignment."""
CORRELATION_MIN = 0.6
"""Correlation of the rates below which the clocks count as not aligned."""
SURE = 0.9
"""Correlation above which no other convention of the quaternion is tried."""
READINGS = {"xyzw": "xyzw", "inverse": "world to body", "xyzw+inverse": "xyzw and world to body"}
"""Possible other conventions of a file's quaternions: steps of `read_as` -> description."""
OTHER_WORLD = ("vel", "cmd_quat")
"""Signals in the log's world frame, which is not that of the pose."""
USUAL_STEP_S = 1.0 / 150.0
"""Usual time between poses [s]; cameras and trackers give 30 to 1000 a second."""
LONG_S = 7200.0
"""Longest recording that is aligned; longer ones have a wrong unit of time or a jump [s]."""
DRIFT_MAX = 2e-3
"""Relative drift of two clocks above which the alignment is rejected as wrong."""
DRIFT = 2e-4
"""Largest relative drift of two sound crystals; a larger one is reported as a fault."""
ROTATION_DEG = 15.0
"""Rotation between body frames that is corrected [deg]; less may be a tilt of markers."""


@dataclass(frozen=True)
class Alignment:
    """Relation of the pose's clock and body frame to the log's."""

    offset_s: float
    """Time on the log's clock at which the pose's clock shows 0 [s]."""
    drift: float
    """Seconds of the log's clock per second of the pose's clock, minus 1."""
    rotation: np.ndarray
    """(3, 3) rotation from the pose's body axes to the gyro's."""
    correlation: float
    """Correlation of the two body rates after the alignment."""
    offset_sd_s: float
    """Standard error of the offset in the middle of the flight [s]."""
    drift_sd: float
    """Standard error of the drift."""

    @property
    def rotation_deg(self) -> float:
        """Angle of `rotation` [deg]."""
        return float(np.rad2deg(np.linalg.norm(rotation_vector(rot_to_quat(self.rotation)))))


def with_pose(recording: Recording, options: ImportOptions) -> Recording:
    """Return `recording` with position and attitude of the file `options.pose`, and its findings.

    Raises:
        FlightLogError: where the files cannot be aligned, or one lacks the signals for it.
        ValueError: for a mapping file that cannot be used.
    """
    assert options.pose is not None
    pose = table.read(options.pose, replace(options, map=options.pose_map))
    pose = with_readings(pose, tuple(r for r in options.read if r[0] in OF_POSE))
    for name, text in (("pos", "position"), ("quat", "attitude")):
        if name not in pose.signals:
            raise FlightLogError(options.pose, f"holds no {text}; name its columns with --pose-map")
    if "rate" not in recording.signals:
        raise FlightLogError(recording.name, "holds no gyro to align a pose with")
    pose = _in_seconds(pose)
    for source, samples in ((pose, pose.signals["quat"]), (recording, recording.signals["rate"])):
        if (length_s := samples.time_s[-1] - samples.time_s[0]) > LONG_S:
            reason = f"lasts {length_s:.4g} s, more than {LONG_S:g} s; name its unit of time, or "
            raise FlightLogError(source.name, reason + "cut it", "time")
    quat, alignment, attitude_findings = _align_pose(pose, recording, options.fix)
    rotation_deg = alignment.rotation_deg
    text = (
        f"its clock is {alignment.offset_s:+.4f} s (± {1e3 * alignment.offset_sd_s:.2g} ms) "
        f"from the log's and runs {1e6 * alignment.drift:+.0f} ppm off; "
        f"rates correlate by {alignment.correlation:.3f}"
    )
    findings = [*pose.findings]
    if left_out := [name for name in OTHER_WORLD if name in recording.signals]:
        note = f"{' and '.join(left_out)} of the log are in another world frame: left out"
        findings.append(Finding("note", "pose", note))
    findings += [Finding("ok", "pose clock", text), *attitude_findings]
    if abs(alignment.drift) > max(DRIFT, 4.0 * alignment.drift_sd):
        text = (
            f"its clock runs {1e6 * alignment.drift:+.0f} ppm (± {1e6 * alignment.drift_sd:.0f}) "
            "off the log's, more than two crystals do: its times are corrected"
        )
        about = ("clock_drift", alignment.drift, 0.95)
        findings.append(Finding("corrected", "pose clock", text, *about))
    joined = _join(recording, pose, quat, alignment)
    if rotation_deg > ROTATION_DEG and not _has_wrong_sign(joined):
        axis_b = rotation_vector(rot_to_quat(alignment.rotation)) / np.deg2rad(rotation_deg)
        axis = ", ".join(f"{v:+.2f}" for v in axis_b)
        text = f"its body is rotated by {rotation_deg:.1f} deg about ({axis}) against the gyro"
        if options.fix:
            change = conjugate(rot_to_quat(alignment.rotation))
            quat = Signal(quat.time_s, multiply(quat.value, np.broadcast_to(change, (1, 4))))
            joined = _join(recording, pose, quat, alignment)
        status = "corrected" if options.fix else "doubt"
        findings.append(Finding(status, "pose axes", text, "body_frame", None, 0.9))
    elif rotation_deg > 1.0:
        text = f"its body is rotated by {rotation_deg:.1f} deg against the gyro; not corrected"
        findings.append(Finding("note", "pose axes", text))
    return joined.noting(*findings)


def _join(recording: Recording, pose: Recording, quat: Signal, alignment: Alignment) -> Recording:
    """Return `recording` with the pose, whose attitude is `quat`, on the recording's clock."""
    signals = {n: samples for n, samples in recording.signals.items() if n not in OTHER_WORLD}
    for name, samples in {**pose.signals, "quat": quat}.items():
        if name in OF_POSE:
            time_s = alignment.offset_s + (1.0 + alignment.drift) * samples.time_s
            signals[name] = Signal(time_s, samples.value)
    return replace(recording, signals=signals)


def _has_wrong_sign(recording: Recording) -> bool:
    """Return whether the path shows that one angle of the attitude has the wrong sign."""
    rows = rows_at(recording, row_times(recording))
    fits = fit_pose_readings({k: v for k, v in rows.items() if k != "rate"})
    if fits is None or fits.given.force is None or fits.best.force is None:
        return False
    better = fits.best.force < GOOD and fits.given.force > TIMES_BETTER * fits.best.force
    return better and fits.best.quat in ANGLES


def _in_seconds(pose: Recording) -> Recording:
    """Return the pose with its time in seconds, in the unit that gives a usual camera rate."""
    time_s = pose.signals["quat"].time_s
    step, length = median_step(time_s), time_s[-1] - time_s[0]
    # A slow pose is no fast one in a smaller unit, in which it would be too short.
    units = [unit for unit, factor in TIMES.items() if length * factor >= OVERLAP_S] or list(TIMES)
    unit = min(units, key=lambda name: abs(np.log(step * TIMES[name] / USUAL_STEP_S)))
    if unit == "s":
        return pose
    text = f"rows are {step:.4g} apart, so time is in {unit}"
    noted = pose.noting(Finding("corrected", "pose time", text, "time_unit"))
    return with_readings(noted, (("time", unit),))


def _align_pose(
    pose: Recording, recording: Recording, fix: bool
) -> tuple[Signal, Alignment, list[Finding]]:
    """Return the attitude in the convention that agrees best with the gyro, and its alignment."""
    quat, rate = pose.signals["quat"], recording.signals["rate"]
    unchanged = align(quat, rate, pose.name)
    if unchanged.correlation > SURE and unchanged.rotation_deg <= ROTATION_DEG:
        return quat, unchanged, []
    # Another convention must at least halve the distance of the correlation from 1.
    enough = max(SURE, 0.5 + 0.5 * unchanged.correlation)
    converted = {
        steps: Signal(quat.time_s, read_as("quat", quat.value, steps))
        for steps in (*READINGS, *ANGLES)
    }
    aligned = {steps: align(signal, rate, pose.name) for steps, signal in converted.items()}
    # Among conventions with equal correlation, prefer a body frame close to the gyro's.
    best = max(aligned, key=lambda s: aligned[s].correlation + 0.1 * aligned[s].rotation.trace())
    if fix and best in READINGS and aligned[best].correlation > enough:
        fault = "quaternion_order" if "xyzw" in best else "quaternion_direction"
        text = f"it agrees with the gyro only if it is {READINGS[best]}"
        about = (fault, None, aligned[best].correlation)
        finding = Finding("corrected", "pose attitude", text, *about)
        return converted[best], aligned[best], [finding]
    # One wrong sign and a mirrored gyro serve to align the clocks only: later checks decide which
    # signal is wrong (`eval/logs/faults/pose.py`, `vectors.py`).
    mirrored = align(quat, rate, pose.name, mirrored=True)
    wrong_sign = max((mirrored, *(aligned[s] for s in ANGLES)), key=lambda fit: fit.correlation)
    if wrong_sign.correlation > enough:
        return quat, replace(wrong_sign, rotation=np.eye(3)), []
    if unchanged.correlation < CORRELATION_MIN or abs(unchanged.drift) > DRIFT_MAX:
        reason = (
            f"its clock cannot be aligned with the log's: at best the body rates correlate by "
            f"{unchanged.correlation:.2f} (drift {1e6 * unchanged.drift:.0f} ppm). Are both of "
            "the same flight, is time in seconds, and does the body rotate enough?"
        )
        raise FlightLogError(pose.name, reason)
    return quat, unchanged, []


def align(quat: Signal, rate: Signal, name: str, mirrored: bool = False) -> Alignment:
    """Return the alignment of `quat` (wxyz, body to world) with the gyro `rate` [rad/s].

    Each is on its own clock. With `mirrored`, a reflection is fitted instead of a rotation (one
    axis of the gyro is inverted).

    Raises:
        FlightLogError: where either signal is too short or has too few samples.
    """
    centre_s, pose_rate_b = _pose_rates(quat)
    if len(centre_s) < MIN_SAMPLES:
        raise FlightLogError(name, "too few poses to align the clocks by")
    offset = _coarse_offset(centre_s, pose_rate_b, rate, name)
    shared = (centre_s + offset > rate.time_s[0]) & (centre_s + offset < rate.time_s[-1])
    # During the fit, the offset is that in the middle of the flight.
    fit = Alignment(offset, 0.0, np.eye(3), 0.0, np.inf, np.inf)
    if np.sum(shared) < MIN_SAMPLES:
        return fit  # the poses have a hole where the clocks would agree: no alignment
    middle = float(np.mean(centre_s[shared]))
    reach, full_reach = FIRST_REACH_S, float(np.max(np.abs(centre_s - middle)))
    # From the middle outwards, because over a long flight the drift is too large for one step.
    while True:
        in_reach = np.abs(centre_s - middle) <= reach
        for _ in range(20):
            fit, change = _refine(
                centre_s[in_reach], pose_rate_b[in_reach], rate, middle, fit, mirrored
            )
            if np.all(np.abs(change) < [1e-7, 1e-9]):
                break
        if reach >= full_reach:
            break
        reach *= 2.0
    return replace(fit, offset_s=fit.offset_s - fit.drift * middle)


def _refine(
    centre_s: np.ndarray,
    pose_rate_b: np.ndarray,
    rate: Signal,
    middle: float,
    fit: Alignment,
    mirrored: bool,
) -> tuple[Alignment, np.ndarray]:
    """Return the result of one Gauss-Newton step from `fit`, and the change of offset and drift."""
    time_s = centre_s + fit.offset_s + fit.drift * (centre_s - middle)
    in_gyro_log = (time_s > rate.time_s[0] + SPAN_S) & (time_s < rate.time_s[-1] - SPAN_S)
    if np.sum(in_gyro_log) < MIN_SAMPLES:
        return fit, np.zeros(2)
    time_s, pose_rate_b = time_s[in_gyro_log], pose_rate_b[in_gyro_log]
    since_middle_s = (centre_s - middle)[in_gyro_log, None]
    gyro = averaged(rate.time_s, rate.value, time_s, SPAN_S)
    step = 0.5 * SPAN_S  # the slope over a shorter time is mostly noise
    later = averaged(rate.time_s, rate.value, time_s + step, SPAN_S)
    sooner = averaged(rate.time_s, rate.value, time_s - step, SPAN_S)
    slope = (later - sooner) / (2.0 * step)
    rotation = _kabsch(pose_rate_b - pose_rate_b.mean(0), gyro - gyro.mean(0), mirrored)
    rotated = pose_rate_b @ rotation.T
    # The scale is free: `faults/vectors.py` finds a gyro in other units.
    centred = rotated - rotated.mean(0)
    scale = float(np.sum(gyro * centred) / max(np.sum(centred**2), 1e-12))
    residual = gyro - scale * rotated
    # residual = bias + slope * (error of the offset + error of the drift * since_middle_s)
    columns = [slope.ravel(), (slope * since_middle_s).ravel()]
    columns += [np.tile(axis, len(rotated)) for axis in np.eye(3)]
    design = np.stack(columns, axis=1)
    weight = _huber_weights(residual)
    normal = design.T @ (design * weight[:, None])
    solution = np.linalg.lstsq(normal, design.T @ (weight * residual.ravel()), rcond=None)[0]
    change = np.clip(solution[:2], [-0.05, -1e-3], [0.05, 1e-3])
    noise = float(np.mean(weight * (residual.ravel() - design @ solution) ** 2))
    # Neighbouring body rates share samples, which reduces the number of independent body rates.
    overlap = max(1.0, SPAN_S / median_step(centre_s))
    variance = overlap * noise / np.maximum(np.diag(normal)[:2], 1e-12)
    offset, drift = fit.offset_s - change[0], fit.drift - change[1]
    correlation = _correlation(gyro, rotated)
    return Alignment(offset, drift, rotation, correlation, *np.sqrt(variance).tolist()), change


def _pose_rates(quat: Signal) -> tuple[np.ndarray, np.ndarray]:
    """Return middles (K,) [s] of spans of `SPAN_S`, and their mean body rates (K, 3) [rad/s]."""
    value = continuous(quat.value / np.linalg.norm(quat.value, axis=1, keepdims=True))
    step = median_step(quat.time_s)
    count = max(1, round(SPAN_S / step))
    duration, rates = rates_between(quat.time_s, value, count)
    no_gap = duration < 1.5 * count * step
    return (0.5 * (quat.time_s[count:] + quat.time_s[:-count]))[no_gap], rates[no_gap]


def _coarse_offset(centre_s: np.ndarray, pose_rate_b: np.ndarray, rate: Signal, name: str) -> float:
    """Return the log's clock minus the pose's clock [s], by correlating the rates' magnitudes."""
    pose_grid, log_grid = (np.arange(t[0], t[-1], GRID_S) for t in (centre_s, rate.time_s))
    min_overlap = int(OVERLAP_S / GRID_S)
    if min(len(pose_grid), len(log_grid)) < min_overlap:
        raise FlightLogError(name, f"less than {OVERLAP_S:g} s to align clocks by")
    pose = np.interp(pose_grid, centre_s, np.linalg.norm(pose_rate_b, axis=1))
    # The vector is averaged before its magnitude, because averaged magnitudes keep the noise.
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
    # A short overlap correlates by chance more easily, so its score is reduced.
    overlap_weight = np.sqrt(np.clip(shared / min(len(pose), len(log)), 0.0, 1.0))
    score = np.where(shared > min_overlap, product / energy * overlap_weight, -1.0)
    lag = int(np.argmax(score))
    # Lags from 0 to the length of the log are positive; negative ones are at the transform's end.
    lag = lag if lag < len(log) else lag - size
    return float(log_grid[0] - pose_grid[0] + lag * GRID_S)


def _kabsch(source: np.ndarray, target: np.ndarray, mirrored: bool) -> np.ndarray:
    """Return the rotation (3, 3), or reflection, from `source` (K, 3) to `target`."""
    u, s, vt = np.linalg.svd(target.T @ source)
    if s[1] < 1e-3 * s[0]:
        return np.eye(3)  # rates about one axis do not determine the rotation of the frames
    sign = np.sign(np.linalg.det(u @ vt)) * (-1.0 if mirrored else 1.0)
    return u @ np.diag([1.0, 1.0, sign]) @ vt


def _huber_weights(residual: np.ndarray) -> np.ndarray:
    """Return Huber's weights (3 K,) for residuals (K, 3), the same for the three of a row."""
    size = np.linalg.norm(residual - np.median(residual, axis=0), axis=1)
    limit = 2.5 * max(float(np.median(size)), 1e-9)
    return np.repeat(np.minimum(1.0, limit / np.maximum(size, 1e-12)), 3)


def _correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Return the correlation of two vector signals (K, 3) over all axes together."""
    first, second = first - first.mean(0), second - second.mean(0)
    norm = np.sqrt(np.sum(first**2) * np.sum(second**2))
    return float(np.sum(first * second) / norm) if norm > 0 else 0.0

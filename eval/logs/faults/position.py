"""Checks of a position: its unit and clock and the sign of z by the vertical force, and jumps.

Gravity dominates the force, so `pose.check_pose` hardly depends on this sign: with z inverted, the
force still points along body z. But the vertical acceleration of the path then has the wrong sign.
Its *slope* is the ratio of that acceleration to the one from a measured or commanded force: 1 for
the right sign, -1 for the wrong one and 0 where both are unrelated. Attitude errors hardly change
it, as they hardly change the vertical part of the force.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.frames import rotate
from eval.logs.faults.finding import Finding, unseen
from eval.logs.faults.pose import WIDTH_S as GYRO_S
from eval.logs.faults.pose import Rows, turns_of
from eval.logs.faults.reading import option
from eval.logs.faults.relation import (
    OK,
    interpolate,
    jackknife_error,
    match,
    pooled_scale,
    smooth,
)
from eval.logs.velocity import velocity_from_position

WIDTH_S = 0.4
"""Averaging time of both accelerations [s]. It leaves little above 1.5 Hz, so that a delay of up to
0.15 s between them does not change the slope's sign."""
BLOCK_S, BLOCKS = 1.0, 12
"""Least duration of a block of the jackknife [s], longer than errors are correlated, and largest
number of blocks."""
NEARER = 0.5
"""Least size of the slope: above it, a slope of 1 or -1 fits the flight better than 0."""
CHANCE = 1e-4
"""Largest probability of such a slope where both accelerations are unrelated."""
NEAR_CLOCK, AGREE = 1.03, 1.015
"""Least factor of a wrong clock that both gyro and velocity show, and by how much they may differ.
In real logs filters change one of them by up to a tenth, but not both alike."""
CLOCK, SURE_SLOPE, NEAR_SLOPE = 1.1, 4.0, 0.3
"""Least factor of a wrong clock on the gyro; the path's slope is then as many standard errors from
1, and within this share of that distance from the value by this factor."""
FOOT_M, FOOT_WITHIN = 0.3048, 0.15
"""A foot [m], and the largest relative error of the most certain slope that shows this unit."""
FLYING = 0.3
"""Rows with less than this share of the median force are not used: on the ground or in a fall."""
ACC_MAX = 60.0
"""Largest possible acceleration [m/s^2]."""
LEAST_M, SURE_SD = 0.1, 10.0
"""Least size of a jump: in metres, and in standard deviations of the usual steps."""
STEPS = 5
"""Number of steps before and after, of which the median is the velocity."""
MEDIAN_SAMPLES = 7
"""Number of samples of the running median with which a position is compared."""
KEPT_M = 0.02
"""Distances from the neighbours up to this size are no jump [m]."""
FAR = 50.0
"""In an unknown unit, a jump exceeds this many times the smaller of two sizes: the median step, and
the distance from the running median that nine of ten positions keep."""
FAULT_M = 0.5
"""A jump below this size is a note [m]: the estimators of real vehicles correct themselves so."""


class Slope(NamedTuple):
    """Ratio of the path's vertical acceleration to that of a force."""

    source: str
    """What measures or commands the force, in words."""
    value: float
    """The ratio: 1 for the right sign of z, -1 for the wrong one, 0 for no relation."""
    error: float
    """Standard error of `value`, by jackknife."""
    blocks: int
    """Number of blocks of the jackknife."""

    def shows(self, sign: float) -> bool:
        """Return whether the slope has this sign (1 or -1), by Student's t for the blocks."""
        from scipy.special import stdtrit

        least = float(stdtrit(self.blocks - 1, 1.0 - CHANCE)) * self.error
        return sign * self.value > max(NEARER, least)


def check_clock_rate(rows: Rows) -> list[Finding]:
    """Return the finding on a clock by which rates and accelerations have one wrong factor.

    If times are too long by a factor, the attitude's turns are too small by it, and the path's
    accelerations by its square.
    """
    if not {"pos", "quat", "rate"} <= rows.keys():
        return []
    turns = smooth(rows["time"], turns_of(rows["time"], rows["quat"]), GYRO_S)
    found = match(turns, smooth(rows["time"], rows["rate"], GYRO_S))
    scale = pooled_scale(found)[0]
    if not np.isfinite(scale) or found.is_turned:
        return []
    if 1.0 / CLOCK < scale < CLOCK:
        return _small_clock_rate(rows, scale)
    gyro = f"the gyro is {scale:.3g} times the attitude's turns, and "
    if not (slopes := _slopes(rows)):
        return unseen("time", f"{gyro}no force shows whether that is the clock's rate", "time_unit")
    one = min(slopes, key=lambda slope: slope.error)
    text = f"{gyro}the path's vertical acceleration is {one.value:.2f} (± {one.error:.2f}) times "
    text += f"that of the {one.source}: "
    far = abs(one.value - 1.0)
    if far < SURE_SLOPE * one.error or abs(one.value - scale**-2) > NEAR_SLOPE * far:
        return unseen("time", f"{text}a clock's rate does not show", "time_unit")
    return [_clock_rate(f"{text}its steps are {scale:.3g} times the true ones", scale)]


def _small_clock_rate(rows: Rows, scale: float) -> list[Finding]:
    """Return the finding on a clock whose rate is off by less than a tenth, if two signals agree.

    `scale` is that of the gyro. A filter or a wrong scale of one sensor changes one of them only.
    """
    if abs(np.log(scale)) < np.log(NEAR_CLOCK):
        return []
    gyro = f"the gyro is {scale:.3g} times the attitude's turns"
    if "vel" not in rows:
        text = f"{gyro}, and no velocity shows whether that is the clock's rate"
        return unseen("time", text, "time_unit")
    path = velocity_from_position(rows["time"], rows["pos"])
    found = match(*(smooth(rows["time"], value, GYRO_S) for value in (path, rows["vel"])))
    speed, low, high = pooled_scale(found)
    text = f"{gyro}, and the velocity {speed:.3g} times the path's derivative"
    is_alike = low / AGREE < scale < high * AGREE and found.misfit(found.as_given) < OK
    if not is_alike or low / NEAR_CLOCK < 1.0 < high * NEAR_CLOCK:
        return unseen(
            "time", f"{text}: filters or scales, so a clock's rate does not show", "time_unit"
        )
    return [_clock_rate(f"{text}: its steps are about {speed:.3g} times the true ones", speed)]


def _clock_rate(text: str, scale: float) -> Finding:
    """Return the finding on times that are `scale` times the true ones."""
    fix = "the unit or rate of the time column in the mapping, or "
    fix += option(("time", f"{1.0 / scale:.4g}"))
    return Finding("doubt", "time", text, "time_unit", scale, 0.95, fix)


def check_height(rows: Rows) -> list[Finding]:
    """Return the finding on the sign of the position's z, and on its unit."""
    if not {"pos", "quat"} <= rows.keys():
        return []
    slopes = _slopes(rows)
    if not slopes:
        text = "no accelerometer, thrust command or rotor speed shows the sign of z"
        return unseen("position", text, "position_axes")
    text = "its vertical acceleration is " + " and ".join(
        f"{s.value:.2f} (± {s.error:.2f}) times that of the {s.source}" for s in slopes
    )
    right, inverted = (any(slope.shows(sign) for slope in slopes) for sign in (1.0, -1.0))
    if inverted and any(slope.value > SURE_SLOPE * slope.error for slope in slopes):
        return unseen("position", f"{text}: these contradict each other", "position_axes")
    if right == inverted:
        return unseen("position", f"{text}: too uncertain for the sign of z", "position_axes")
    feet = [FOOT_M * slope.value for slope in sorted(slopes, key=lambda slope: slope.error)]
    if right and min(feet) > 0.5 and abs(feet[0] - 1.0) < FOOT_WITHIN:
        fix = option(("pos", f"{FOOT_M:g}"))
        about = ("position_unit", 1.0 / FOOT_M, 0.97, fix)
        return [Finding("corrected", "position", f"{text}: it is in feet", *about)]
    if right:
        return [Finding("ok", "position", text)]
    text = f"{text}: z has the other sign"
    fix = option(("pos", "x,y,-z"))
    return [Finding("corrected", "position", text, "position_axes", None, 0.98, fix)]


def _slopes(rows: Rows) -> list[Slope]:
    """Return the slopes for all sources of the force; none without a pose."""
    if not {"pos", "quat"} <= rows.keys():
        return []
    vel = velocity_from_position(rows["time"], rows["pos"])
    acc = velocity_from_position(rows["time"], vel)[:, 2]
    found = [_slope(name, rows["time"], acc, force) for name, force in _forces(rows)]
    return [slope for slope in found if slope is not None]


def _forces(rows: Rows) -> Iterator[tuple[str, np.ndarray]]:
    """Yield each source of the force in words, and its vertical part (T,) in the world, any unit.

    Up is positive in the world. The thrust of rotors grows with the square of their speeds.
    """
    quat = rows["quat"]
    up = rotate(quat, np.array([0.0, 0.0, 1.0]))[:, 2]
    if "acc" in rows:
        yield "accelerometer", rotate(quat, rows["acc"])[:, 2]
    if "cmd_thrust" in rows:
        yield "thrust command", up * rows["cmd_thrust"][:, 0]
    if "motor" in rows:
        yield "rotor speeds", up * np.sum(rows["motor"] ** 2, axis=1)


def _slope(source: str, time_s: np.ndarray, acc: np.ndarray, force: np.ndarray) -> Slope | None:
    """Return the slope of the path's vertical acceleration, None where too little is known.

    Over a flight the mean force balances gravity. This gives the force's unit and sign. The force
    (T,) is in any unit; `acc` (T,) is in m/s^2, `time_s` (T,) in s.
    """
    count = min(int((time_s[-1] - time_s[0]) / BLOCK_S), BLOCKS)
    acc, force = (smooth(time_s, value[:, None], WIDTH_S)[:, 0] for value in (acc, force))
    good = np.isfinite(acc) & np.isfinite(force)
    if count < 2 or not np.any(force[good]):
        return None
    good &= np.abs(force) >= FLYING * abs(np.median(force[good]))
    good &= np.abs(acc) < 4.0 * np.median(np.abs(acc[good])) + 1.0
    block = (count * np.arange(len(time_s)) // len(time_s))[good]
    change, path = force[good] - force[good].mean(), acc[good] - acc[good].mean()
    product = np.bincount(block, change * path, count)
    square = np.bincount(block, change**2, count)
    if not np.min(square.sum() - square) > 0.0:
        return None
    unit = float(force[good].mean()) / GRAVITY
    without_block = unit * (product.sum() - product) / (square.sum() - square)
    value = unit * float(product.sum() / square.sum())
    return Slope(source, value, jackknife_error(without_block), count)


def jumps_of(time_s: np.ndarray, pos: np.ndarray, in_metres: bool) -> np.ndarray:
    """Return how far positions (N, 3) that jump and come back are from their neighbours (N,).

    Others are 0. Without `in_metres` the unit is unknown, and only far jumps count.
    """
    from scipy.ndimage import median_filter

    jump, half = np.zeros(len(pos)), MEDIAN_SAMPLES // 2
    known = np.flatnonzero(np.isfinite(pos).all(axis=1))
    if len(known) <= MEDIAN_SAMPLES:
        return jump
    time_s, pos = time_s[known], pos[known]
    usual = median_filter(pos, (MEDIAN_SAMPLES, 1), mode="nearest")
    usual[:half], usual[-half:] = usual[half], usual[-half - 1]
    distance = np.abs(pos - usual).max(axis=1)
    reach_s = half * float(np.median(np.diff(time_s)))
    least = KEPT_M + 0.5 * ACC_MAX * reach_s**2
    if not in_metres:
        step = np.linalg.norm(np.diff(pos, axis=0), axis=1)
        step = step[step > 0.0] if step.any() else step
        sizes = [float(np.quantile(distance, 0.9)), float(np.median(step))]
        least = FAR * min((size for size in sizes if size > 0.0), default=np.inf)
    limit = np.full(len(pos), least)
    limit[:half] = limit[-half:] = FAR * least  # the median is not around the ends
    # Outliers move the median, so that their neighbours seem to jump too: compare with the rest.
    bad, good = np.flatnonzero(distance > limit), np.flatnonzero(distance <= limit)
    if len(bad) > len(good):
        return jump  # noise, or the positions of two bodies: most have nothing to come back to
    after = np.searchsorted(good, bad)
    before_s = time_s[bad] - time_s[good[np.maximum(after - 1, 0)]]
    after_s = time_s[good[np.minimum(after, len(good) - 1)]] - time_s[bad]
    line = interpolate(time_s[bad], time_s[good], pos[good])
    distance = np.abs(pos[bad] - line).max(axis=1)
    curve_m = KEPT_M + 0.5 * ACC_MAX * np.maximum(before_s * after_s, 0.0)
    jump[known[bad]] = np.where(distance > (curve_m if in_metres else least), distance, 0.0)
    return jump


def check_jumps(time_s: np.ndarray, pos: np.ndarray) -> list[Finding]:
    """Return the finding on the largest jump of a position, [] for none.

    A jump is a step between two samples that neither the velocity before nor the one after it
    explains; after a collision, the latter does. Rows that are missing only make a step longer.

    Args:
        time_s: (N,) increasing times [s].
        pos: (N, 3) positions, NaN where unknown.
    """
    # Of a position that is held between its samples, the first row of each counts.
    known = np.flatnonzero(np.isfinite(pos).all(axis=1))
    is_new = (np.diff(pos[known], axis=0) != 0.0).any(axis=1) & (np.diff(time_s[known]) > 0.0)
    known = known[np.append(True, is_new)] if len(known) else known
    time_s, pos = time_s[known], pos[known]
    if len(time_s) < 4 * STEPS:
        return []
    step_s = np.diff(time_s)
    velocity = np.diff(pos, axis=0) / step_s[:, None]
    windows = np.lib.stride_tricks.sliding_window_view(velocity, STEPS, axis=0)
    usual = np.median(windows, axis=-1)
    k = np.arange(STEPS, len(step_s) - STEPS)
    size_m = step_s[k] * np.min(
        [np.linalg.norm(velocity[k] - usual[k + other], axis=1) for other in (-STEPS, 1)], axis=0
    )
    # The median velocity is that of the middle of its window: half of its steps away.
    around_s = np.lib.stride_tricks.sliding_window_view(step_s, 2 * STEPS + 1).mean(axis=-1)
    turned_m = ACC_MAX * 0.5 * (STEPS + 1) * around_s * step_s[k]
    noise_m = SURE_SD / 0.6745 * float(np.median(size_m))
    excess_m = size_m - (LEAST_M + turned_m + 0.5 * ACC_MAX * step_s[k] ** 2 + noise_m)
    jumps = np.flatnonzero(excess_m > 0.0)
    if not len(jumps):
        return []
    worst = jumps[np.argmax(size_m[jumps])]
    first = int(k[worst])
    others = f" ({len(jumps)} such steps)" if len(jumps) > 1 else ""
    at_s, jump_m = float(time_s[first]), float(size_m[worst])
    text = f"it jumps by {jump_m:.2g} m between two rows at t = {at_s:.2f} s{others}: a glitch"
    if jump_m < FAULT_M:
        return [Finding("note", "position", text)]
    text += ", or two flights in one file"
    fix = "cut the log there with --start or --end of suite import"
    return [Finding("doubt", "position", text, "position_jump", jump_m, 0.95, fix)]

"""Does the attitude turn as the gyro says? Tells the quaternion's order and sense, and gyro axes.

The rate that follows from the attitude over 60 ms is held against the gyro's mean over the same
time, for every reading of the quaternion that is common: wxyz or xyzw, body to world or world to
body, gyro in the attitude's body frame or turned over (forward-right-down).
"""

from __future__ import annotations

import itertools

import numpy as np

from eval.importers.findings import Finding
from eval.importers.frames import (
    BODY_VECTORS,
    HALF_TURN,
    conjugate,
    multiply,
    rotation_vector,
)
from eval.importers.signals import median_step

SPAN_S = 0.06
"""The attitude is differenced over about this time [s]."""
CALM = 0.2
"""Flights whose rates are below this tell nothing (root mean square, rad/s)."""
GOOD, BAD, TIMES_BETTER = 0.35, 0.6, 3.0
"""A reading is good below the first (residual over rate), bad above the second; only one that is
good, and better than a bad one by the third, is overwhelming evidence."""

_ORDERS = {"wxyz": [0, 1, 2, 3], "xyzw": [3, 0, 1, 2]}
"""What the file's order must have been -> where w, x, y, z are among what was read as wxyz."""
READINGS = tuple(itertools.product(_ORDERS, (False, True), (False, True)))
"""(order, whether it maps world to body, whether the gyro is turned over); first what was given."""


def body_turns(
    time_s: np.ndarray, quat_wxyz: np.ndarray, rate_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean body rates by attitude and by gyro over many short times, both (K, 3)."""
    after, inside, duration = _spans(time_s)
    relative = multiply(conjugate(quat_wxyz[: len(after)]), quat_wxyz[after])
    by_attitude = rotation_vector(relative) / duration[:, None]
    area = 0.5 * np.diff(time_s)[:, None] * (rate_b[1:] + rate_b[:-1])
    full = np.concatenate([np.zeros((1, 3)), np.cumsum(np.nan_to_num(area), axis=0)])
    by_gyro = (full[after] - full[: len(after)]) / duration[:, None]
    holes = np.concatenate([[0], np.cumsum(~np.isfinite(area).all(axis=1))])
    good = inside & (holes[after] == holes[: len(after)]) & np.isfinite(by_attitude).all(axis=1)
    return by_attitude[good], by_gyro[good]


def check_attitude(rows: dict[str, np.ndarray], fix: bool) -> list[Finding]:
    """Check `rows` (see `eval.importers.rows`), correcting them in place where `fix` says so."""
    time_s, quat, rate = rows["time"], rows["quat"], rows["rate"]
    _, gyro = body_turns(time_s, quat, rate)
    size = _rms(gyro)
    if len(gyro) < 30 or size < CALM:
        text = f"rates of {size:.2g} rad/s are too small to check the attitude by"
        return [Finding("note", "attitude", text)]
    residual = {
        (order, inverse, turned): _residual(time_s, as_read(quat, order, inverse), rate, turned)
        for order, inverse, turned in READINGS
    }
    given = residual["wxyz", False, False]
    best = min(residual, key=lambda reading: residual[reading])
    figures = f"its derivative is off the gyro by {100 * given:.0f} % of the rates"
    if given < BAD:
        level = "ok" if given < GOOD else "doubt"
        more = "" if given < GOOD else "; noise, a clock offset or a turned sensor"
        return [Finding(level, "attitude", figures + more)]
    if not (residual[best] < GOOD and residual[best] * TIMES_BETTER < given):
        text = f"{figures}, and no other order, sense or body frame of it fits"
        return [Finding("doubt", "attitude", text)]
    order, inverse, turned = best
    words = [f"the quaternion is {order}"] if order != "wxyz" else []
    words += ["it maps world to body"] if inverse else []
    words += ["the gyro's y and z have the other sign (forward-right-down)"] if turned else []
    text = f"{figures}, but by {100 * residual[best]:.0f} % if " + " and ".join(words)
    if not fix:
        return [Finding("doubt", "attitude", text + "; left as it is")]
    rows["quat"] = as_read(quat, order, inverse)
    if "cmd_quat" in rows:  # written as what it is held against
        rows["cmd_quat"] = as_read(rows["cmd_quat"], order, inverse)
    if turned:
        for name in BODY_VECTORS:
            if name in rows:
                rows[name] = rows[name] * HALF_TURN
    return [Finding("corrected", "attitude", text)]


def _spans(time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    step = median_step(time_s)
    count = max(1, round(SPAN_S / step))
    after = np.arange(count, len(time_s))
    duration = time_s[count:] - time_s[:-count]
    return after, duration < 1.5 * count * step, duration


def as_read(quat: np.ndarray, order: str, inverse: bool) -> np.ndarray:
    """Return quaternions (N, 4) that were read as wxyz, body to world, as of another reading."""
    ordered = quat[:, _ORDERS[order]]
    return conjugate(ordered) if inverse else ordered


def _residual(time_s: np.ndarray, quat: np.ndarray, rate: np.ndarray, turned: bool) -> float:
    by_attitude, by_gyro = body_turns(time_s, quat, rate * HALF_TURN if turned else rate)
    return _rms(by_attitude - by_gyro) / _rms(by_gyro)


def _rms(value: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(value**2, axis=1)))) if len(value) else 0.0

"""Apply the faults of a log (biased sensors, a delayed pose, ...) to simulated data, and undo them.

Faults of a log are effects with the hooks `measure` or `late`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, cast

import numpy as np

from eval.effects import EFFECTS
from eval.effects.interface import Array, Sample, Values, as_arrays
from eval.logs.flight_log import FlightLog
from tracks.geometry.rotation import quat_to_rot, rot_to_quat


def pose_delay(effects: Mapping[str, Values]) -> Any:
    """Return the delay with which poses are logged [s]; 0 where no effect delays them."""
    delays = [delay_of(effects[name]) for name, delay_of in _hooks(effects, "late")]
    return sum(delays[1:], delays[0]) if delays else 0.0


def to_logged(effects: Mapping[str, Values], sample: Sample) -> Sample:
    """Return the logged sample for the true `sample`, whose pose is already delayed."""
    for name, measure in _hooks(effects, "measure"):
        sample = measure(as_arrays(effects[name]), sample)
    return sample


def to_true(effects: Mapping[str, Values], sample: Sample) -> Sample:
    """Return the true sample for the logged `sample`, to first order; the pose remains delayed."""
    for name, measure in reversed(_hooks(effects, "measure")):
        # Values mirrored about neutral undo a fault; neutral is a number for every fault of a log.
        neutral = (cast(float, parameter.neutral) for parameter in EFFECTS[name].parameters)
        values = as_arrays(effects[name])
        mirrored = (2.0 * n - value for n, value in zip(neutral, values, strict=True))
        sample = measure(type(values)(*mirrored), sample)
    return sample


def apply_log_faults(effects: Mapping[str, Values], log: Mapping[str, Array]) -> dict[str, Array]:
    """Return the arrays of `log` (T rows, by their names in a flight log) with every fault applied.

    Args:
        effects: the vehicle's effects; only faults of a log are applied.
        log: `time_s` (T,), `pos_w` (T, 3), `quat_wxyz` (T, 4), `vel_w`, `rate_b` and optionally
            `acc_b`, as the fields of a flight or a flight log; other entries are kept.
    """
    log = dict(log)
    if _hooks(effects, "late"):
        log |= _delayed_poses(log, pose_delay(effects))
    return log | _changed(log, partial(to_logged, effects)) if _hooks(effects, "measure") else log


def true_log(log: FlightLog, effects: Mapping[str, Values]) -> FlightLog:
    """Return `log` without the faults among `effects` but a delay, to first order.

    A value that needs a missing signal (a position on a lever arm needs the attitude) is kept.
    """
    if not _hooks(effects, "measure"):
        return log
    logged = {name: value for name, value in vars(log).items() if value is not None}
    true = {
        name: np.where(np.isfinite(value), value, logged[name])
        for name, value in _changed(logged, partial(to_true, effects)).items()
    }
    return replace(log, **true)


def _changed(log: Mapping[str, Array], change: Callable[[Sample], Sample]) -> dict[str, Array]:
    """Return those arrays of `log` that `change` changes, with their new values."""
    # Signals that the log lacks are zeros in the sample, and are left out of the result.
    zeros = 0.0 * log["time_s"][:, None] + log["time_s"].__array_namespace__().zeros(3)
    signals = {name: zeros if log.get(name) is None else log[name] for name in Sample._fields[2:]}
    pos_w, quat = log.get("pos_w", zeros), log.get("quat_wxyz")
    rot_w = zeros[:, None] if quat is None else quat_to_rot(quat)
    given = Sample(pos_w, rot_w, **signals)
    changed = {
        name: new
        for name, new, old in zip(Sample._fields, change(given), given, strict=True)
        if new is not old and (name == "rot_w" or log.get(name) is not None)
    }
    if "rot_w" in changed:
        new_rot_w = changed.pop("rot_w")
        changed |= {} if quat is None else {"quat_wxyz": rot_to_quat(new_rot_w)}
    return changed


def time_shifted(time_s: Array, series: Array, offset: Array) -> Array:
    """Return `series` (T, K) at the times `time_s` (T,) - `offset` [s].

    Between rows it is the cubic polynomial through the four nearest ones (Lagrange), or through
    fewer if there are fewer. Beyond the ends it is the line through the first or last two rows.
    """
    xp = time_s.__array_namespace__()
    count, source_s = min(4, len(time_s)), xp.clip(time_s - offset, time_s[0], time_s[-1])
    before = xp.searchsorted(time_s, source_s, side="right") - count // 2
    rows = xp.clip(before, 0, len(time_s) - count)[:, None] + xp.arange(count)
    at_s, shifted = time_s[rows], 0.0
    for k in range(count):
        others = [j for j in range(count) if j != k]
        weight = 1.0 + 0.0 * source_s
        for j in others:
            weight = weight * (source_s - at_s[:, j]) / (at_s[:, k] - at_s[:, j])
        shifted = shifted + weight[:, None] * series[rows[:, k]]
    beyond_s = (time_s - offset - source_s)[:, None]
    slopes = xp.diff(series, axis=0) / xp.diff(time_s)[:, None]
    return shifted + beyond_s * xp.where(beyond_s < 0.0, slopes[0], slopes[-1])


def _delayed_poses(log: Mapping[str, Array], delay: Array) -> dict[str, Array]:
    """Return `pos_w`, `quat_wxyz` and `vel_w` with the values of time t - delay in the row of t."""
    time_s = log["time_s"]
    xp = time_s.__array_namespace__()
    present = [name for name in ("pos_w", "vel_w") if log.get(name) is not None]
    poses = {name: time_shifted(time_s, log[name], delay) for name in present}
    quat = log["quat_wxyz"]
    # q and -q are the same attitude; interpolation needs neighbouring rows of the same sign.
    flips = xp.where(xp.sum(quat[1:] * quat[:-1], axis=-1) < 0.0, -1.0, 1.0)
    sign = xp.concatenate([xp.ones(1), xp.cumprod(flips)])
    quat = time_shifted(time_s, quat * sign[:, None], delay)
    poses["quat_wxyz"] = quat / xp.sqrt(xp.sum(quat**2, axis=-1, keepdims=True))
    return poses


def _hooks(effects: Mapping[str, Values], hook: str) -> list[tuple[str, Any]]:
    """Return (name, function) of those `effects` that have the hook, in the catalogue's order."""
    hooks = ((name, getattr(EFFECTS[name], hook)) for name in EFFECTS if name in effects)
    return [(name, function) for name, function in hooks if function is not None]

"""Apply the faults of a log to logged arrays and to samples of a simulation, and undo them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from eval.effects import EFFECTS
from eval.effects.interface import Array, Sample, Values
from tracks.geometry.rotation import quat_to_rot, rot_to_quat


def lateness(effects: Mapping[str, Values]) -> Any:
    """Return the delay with which poses are logged [s]; 0 where no effect delays them."""
    late = [of(effects[name]) for name, of in _hooks(effects, "late")]
    return sum(late[1:], late[0]) if late else 0.0


def measured(effects: Mapping[str, Values], sample: Sample) -> Sample:
    """Return the logged sample for the true `sample`, whose pose is already delayed."""
    for name, measure in _hooks(effects, "measure"):
        sample = measure(effects[name], sample)
    return sample


def restored(effects: Mapping[str, Values], sample: Sample) -> Sample:
    """Return the true sample for the logged `sample`, to first order; the delay is kept."""
    for name, measure in reversed(_hooks(effects, "measure")):
        # Values mirrored about neutral, which is a number for every fault of a log.
        neutral = (cast(float, parameter.neutral) for parameter in EFFECTS[name].parameters)
        pairs = zip(neutral, effects[name], strict=True)
        sample = measure(type(effects[name])(*(2.0 * n - value for n, value in pairs)), sample)
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
        log |= _poses_before(log, lateness(effects))
    if not _hooks(effects, "measure"):
        return log
    still = 0.0 * log["time_s"][:, None] + log["time_s"].__array_namespace__().zeros(3)
    given = {name: still if log.get(name) is None else log[name] for name in Sample._fields[2:]}
    pos_w, quat = log.get("pos_w", still), log.get("quat_wxyz")
    rot_w = still[:, None] if quat is None else quat_to_rot(quat)
    true = Sample(pos_w, rot_w, **given)
    seen = measured(effects, true)
    changed = {
        name: new
        for name, new, old in zip(Sample._fields, seen, true, strict=True)
        if new is not old and (name == "rot_w" or log.get(name) is not None)
    }
    if "rot_w" in changed:
        turned = changed.pop("rot_w")
        changed |= {} if quat is None else {"quat_wxyz": rot_to_quat(turned)}
    return log | changed


def shifted(time_s: Array, series: Array, offset: Array) -> Array:
    """Return `series` (T, K) at the times `time_s` (T,) - `offset`, linear between rows.

    Beyond the ends the line through the first or the last two rows is extended.
    """
    xp = time_s.__array_namespace__()
    wanted = time_s - offset
    row = xp.clip(xp.searchsorted(time_s, wanted, side="right") - 1, 0, len(time_s) - 2)
    share = (wanted - time_s[row]) / (time_s[row + 1] - time_s[row])
    return series[row] + share[:, None] * (series[row + 1] - series[row])


def _poses_before(log: Mapping[str, Array], late: Array) -> dict[str, Array]:
    """Return `pos_w`, `quat_wxyz` and `vel_w` of t - late on the rows of t."""
    time_s = log["time_s"]
    xp = time_s.__array_namespace__()
    there = [name for name in ("pos_w", "vel_w") if log.get(name) is not None]
    moved = {name: shifted(time_s, log[name], late) for name in there}
    quat = log["quat_wxyz"]
    # q and -q are one attitude: without a common sign the line between two rows crosses zero.
    flips = xp.where(xp.sum(quat[1:] * quat[:-1], axis=-1) < 0.0, -1.0, 1.0)
    sign = xp.concatenate([xp.ones(1), xp.cumprod(flips)])
    quat = shifted(time_s, quat * sign[:, None], late)
    moved["quat_wxyz"] = quat / xp.sqrt(xp.sum(quat**2, axis=-1, keepdims=True))
    return moved


def _hooks(effects: Mapping[str, Values], hook: str) -> list[tuple[str, Any]]:
    """Return (name, hook) of those of `effects` that have it, in the catalogue's order."""
    found = ((name, getattr(EFFECTS[name], hook)) for name in EFFECTS if name in effects)
    return [(name, one) for name, one in found if one is not None]

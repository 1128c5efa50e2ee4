"""Poses stamped by another clock than the gyroscope's and the commands'."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from eval.effects.interface import Array, Effect, Parameter


class ClockOffset(NamedTuple):
    """Values of `clock_offset`."""

    offset: Array
    """() how much later a pose is logged than it was [s]."""


def shifted(time_s: Array, series: Array, offset: Array) -> Array:
    """Return `series` (T, K) as it was at `time_s` (T,) - `offset`, linear between rows.

    Beyond the ends the first and the last two rows are extended.
    """
    xp = time_s.__array_namespace__()
    wanted = time_s - offset
    row = xp.clip(xp.searchsorted(time_s, wanted, side="right") - 1, 0, len(time_s) - 2)
    share = (wanted - time_s[row]) / (time_s[row + 1] - time_s[row])
    return series[row] + share[:, None] * (series[row + 1] - series[row])


def log_of(values: ClockOffset, log: Mapping[str, Array]) -> dict[str, Array]:
    """Return `pos_w`, `quat_wxyz` and `vel_w` of t - offset on the rows of t."""
    xp = log["time_s"].__array_namespace__()
    moved = {name: log[name] for name in ("pos_w", "vel_w") if log.get(name) is not None}
    moved = {name: shifted(log["time_s"], series, values.offset) for name, series in moved.items()}
    quat = log["quat_wxyz"]
    # q and -q are one attitude: without a common sign the line between two rows crosses zero.
    flips = xp.where(xp.sum(quat[1:] * quat[:-1], axis=-1) < 0.0, -1.0, 1.0)
    sign = xp.concatenate([xp.ones(1), xp.cumprod(flips)])
    quat = shifted(log["time_s"], quat * sign[:, None], values.offset)
    moved["quat_wxyz"] = quat / xp.sqrt(xp.sum(quat**2, axis=-1, keepdims=True))
    return moved


EFFECT = Effect(
    name="clock_offset",
    summary="Pose and velocity are logged late against rates and commands",
    equation="row t: pose and velocity of t - offset, everything else of t",
    source="clocks of motion capture and flight controller not aligned",
    values=ClockOffset,
    parameters=(
        Parameter(
            name="offset",
            unit="s",
            neutral=0.0,
            low=-0.2,
            high=0.2,
            typical=(0.002, 0.02),
        ),
    ),
    log=log_of,
)

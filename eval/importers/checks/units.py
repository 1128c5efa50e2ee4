"""Are time and angles in the units they are said to be in?

Two ratios tell it. The attitude turns by the same angle that the gyro integrates to, and the
position moves by what the velocity integrates to; the first depends on the units of time and of
angles, the second on that of time alone. Both use magnitudes only, which neither the order of a
quaternion's parts nor any choice of frame changes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from eval.importers.findings import Finding
from eval.importers.rows import continuous
from eval.importers.signals import Recording, Signal

TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds in each unit that clocks count in."""
DEG = float(np.pi / 180.0)
ANGLES = {"rad": 1.0, "deg": DEG, "tenths": 0.1}
"""Radians in each unit that rates count in; tenths of the unit that they are said to be in are
what Betaflight logs under `blackbox_high_resolution`, and are looked for in seconds only."""
TENTHS = "rates are ten times too large (blackbox_high_resolution)"
NEAR = 2.0
"""A ratio within this factor of a candidate's speaks for it (the nearest are 10 apart)."""
INTERVALS = 300
"""The path is measured in about this many pieces, so that noise does not lengthen it much."""
CALM_RAD = 0.2
"""An attitude that turns by less than this in all tells nothing [rad]."""


def check_units(recording: Recording, fix: bool) -> tuple[Recording, list[Finding]]:
    """Return the recording with time in s and rates in rad/s, and what was found.

    Args:
        recording: holds quat and rate.
        fix: correct wrong units; otherwise only say so.
    """
    quat, rate = recording.signals["quat"], recording.signals["rate"]
    turned = _path(continuous(quat.value)) * 2.0
    gyro = _integral(rate, quat.time_s[0], quat.time_s[-1])
    if turned < CALM_RAD or not gyro > 0:
        text = f"the attitude turns by {turned:.2g} rad in all: too little to check units by"
        return recording, [Finding("note", "units", text)]
    ratio = turned / gyro
    # Rates measured per unit of the clock: true angle = rate * unit of angle * unit of time.
    found = min(
        [(time, angle) for time in TIMES for angle in ("rad", "deg")] + [("s", "tenths")],
        key=lambda pair: abs(np.log(ratio / _scale(*pair))),
    )
    moved = _moved(recording)
    figures = f"the attitude turns by {ratio:.3g} times what the gyro integrates to"
    if abs(np.log(ratio / _scale(*found))) > np.log(NEAR):
        text = f"{figures}, which no mix-up of units explains; check its column and scale"
        return recording, [Finding("doubt", "units", text)]
    time, angle = found
    if moved is not None:
        figures += f"; the position moves by {moved:.3g} times what the velocity integrates to"
        if abs(np.log(moved / TIMES[time])) > np.log(5.0):
            text = f"{figures}: they do not agree on the unit of time ({time} by the gyro)"
            return recording, [Finding("doubt", "units", text)]
    if (time, angle) == ("s", "rad"):
        return recording, [Finding("ok", "units", f"{figures}: time in s, rates in rad/s")]
    text = f"{figures}: time is in {time} and rates are in {angle}/s"
    if angle == "tenths":
        text = f"{figures}: {TENTHS}"
    if not fix:
        return recording, [Finding("doubt", "units", text + "; left as they are")]
    names = {"rate", "cmd_rate"} if angle == "tenths" and _commands_alike(recording) else {"rate"}
    return _rescaled(recording, TIMES[time], ANGLES[angle], names), [
        Finding("corrected", "units", text)
    ]


def _scale(time: str, angle: str) -> float:
    return TIMES[time] * ANGLES[angle]


def _commands_alike(recording: Recording) -> bool:
    """Return whether commanded rates are about as large as the gyro's, in the same wrong unit."""
    if "cmd_rate" not in recording.signals:
        return False
    size = [np.sqrt(np.mean(recording.signals[n].value ** 2)) for n in ("cmd_rate", "rate")]
    return bool(size[0] > 0.3 * size[1])


def _path(value: np.ndarray) -> float:
    every = max(1, len(value) // INTERVALS)
    return float(np.sum(np.linalg.norm(np.diff(value[::every], axis=0), axis=1)))


def _integral(samples: Signal, first: float, last: float) -> float:
    inside = (samples.time_s >= first) & (samples.time_s <= last)
    time, value = samples.time_s[inside], samples.value[inside]
    every = max(1, len(time) // INTERVALS)
    if len(time) < 3:
        return 0.0
    # Averaged over the same pieces that the path is measured in, so that noise counts alike.
    full = np.concatenate(
        [np.zeros((1, 3)), np.cumsum(0.5 * np.diff(time)[:, None] * (value[1:] + value[:-1]), 0)]
    )
    return float(np.sum(np.linalg.norm(np.diff(full[::every], axis=0), axis=1)))


def _moved(recording: Recording) -> float | None:
    if not {"pos", "vel"} <= recording.signals.keys():
        return None
    pos, vel = recording.signals["pos"], recording.signals["vel"]
    travelled = _integral(vel, pos.time_s[0], pos.time_s[-1])
    path = _path(pos.value)
    return path / travelled if travelled > 0 and path > 0.5 else None


def _rescaled(recording: Recording, time: float, angle: float, names: set[str]) -> Recording:
    signals = {}
    for name, samples in recording.signals.items():
        scale = angle if name in names else 1.0
        signals[name] = Signal(samples.time_s * time, samples.value * scale)
    return replace(recording, signals=signals)

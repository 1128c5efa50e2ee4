"""Readings: ways to interpret a signal, as in `--read rate=x,-y,-z+0.0610352`.

docs/check.md lists the steps; they are joined by `+` and applied from left to right.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.frames import QUAT_HALF_TURN, conjugate, from_euler, multiply, rotate

TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Unit of time -> seconds."""
DEG, RPM = float(np.pi / 180.0), float(np.pi / 30.0)
"""Factors from deg to rad, and from revolutions a minute to rad/s."""
# Signals by what they contain, since each step applies to one group only.
QUATS = ("quat", "cmd_quat")
VECTORS = ("pos", "vel", "rate", "acc", "cmd_rate", "cmd_torque")
MOTORS = ("motor", "motor_cmd", "pwm")
SCALARS = ("throttle", "cmd_thrust", "voltage")
_HALF = np.array([0.0, 1.0, 0.0, 0.0])
"""Quaternion (wxyz) of half a turn about x, which maps between forward-right-down and
forward-left-up axes."""
# How the texts of steps look: axes such as `x,-y,-z`, and an order of motors such as `2,1,4,3`.
_AXES = re.compile(r"^-?[xyz],-?[xyz],-?[xyz]$")
_ORDER = re.compile(r"^[1-4](,[1-4]){3}$")
ANGLES = ("-roll", "-pitch", "-yaw")
"""Steps that change the sign of an angle."""
ORDERS = ("xyzw", "wxyz", "ned-xyzw", "ned-wxyz")
"""Steps that change the order of a quaternion's columns."""
BY_ATTITUDE = ("from-body", "from-world", "plus-gravity")
"""Steps that need an attitude."""
_QUAT_STEPS = (*ORDERS, "inverse", "ned", "frd", *ANGLES)
Readings = tuple[tuple[str, str], ...]
"""(signal, steps) in the order of application."""


def parse_readings(texts: Sequence[str]) -> Readings:
    """Return the readings of options such as `rate=x,-y,-z`.

    Raises:
        ValueError: for an invalid option; the message names it, and what is allowed.
    """
    readings = []
    for text in texts:
        signal, equals, steps = text.partition("=")
        if not equals or signal not in (*QUATS, *VECTORS, *MOTORS, *SCALARS, "time"):
            names = ", ".join((*QUATS, *VECTORS, *MOTORS, *SCALARS, "time"))
            raise ValueError(f"--read {text!r}: give SIGNAL=STEPS; signals are {names}")
        for step in _split(steps):
            if not _allowed(signal, step):
                raise ValueError(
                    f"--read {text!r}: {step!r} is no step of {signal}; allowed are a factor, "
                    "x,-y,-z for vectors, 2,1,4,3 for motors, and what docs/check.md lists"
                )
            if step != steps and (signal == "time" or step == "drop"):
                raise ValueError(f"--read {text!r}: {step!r} stands alone; leave the others out")
        readings.append((signal, steps))
    return tuple(readings)


def option(*readings: tuple[str, str]) -> str:
    """Return readings as options of `suite import`."""
    return " ".join(f"--read {signal}={steps}" for signal, steps in readings)


def readings_in(fix: str) -> Readings:
    """Return the readings in a finding's fix; () where it has no option `--read`."""
    words = fix.split()
    return parse_readings([words[k + 1] for k, w in enumerate(words[:-1]) if w == "--read"])


def read_as(
    signal: str, value: np.ndarray, steps: str, quat: Callable[[], np.ndarray] | None = None
) -> np.ndarray:
    """Return samples (N, C) of a signal after the steps of a reading.

    `quat` returns the attitude (N, 4) wxyz at the same times, for the steps of `BY_ATTITUDE`.
    """
    for step in _split(steps):
        if step == "plus-gravity" and signal == "cmd_thrust":
            value = value + GRAVITY
        elif step in BY_ATTITUDE:
            assert quat is not None
            value = _turned(value, step, quat())
        elif step == "1000-2000":
            value = (value - 1000.0) / 1000.0
        elif signal in QUATS:
            value = _quat_as(value, step)
        elif _AXES.match(step):
            value = value @ axes_matrix(step).T
        elif _ORDER.match(step):
            value = value[:, [int(k) - 1 for k in step.split(",")]]
        else:
            value = value * float(step)
    return value


def read_rows(rows: Mapping[str, np.ndarray], readings: Readings) -> dict[str, np.ndarray]:
    """Return rows (signal to (T, C), `time` to (T,)) with `readings` applied."""
    found = dict(rows)
    for signal, steps in readings:
        if signal == "time":
            found["time"] = found["time"] * seconds(steps)
        elif steps == "drop":
            found.pop(signal, None)
        elif signal in found:
            found[signal] = read_as(signal, found[signal], steps, lambda: found["quat"])
    return found


def seconds(steps: str) -> float:
    """Return the factor of a reading of the time: that of a unit, or a number."""
    return TIMES[steps] if steps in TIMES else float(steps)


def axes_matrix(step: str) -> np.ndarray:
    """Return the matrix (3, 3) of a step such as `x,-y,-z`."""
    matrix = np.zeros((3, 3))
    for row, part in enumerate(step.split(",")):
        matrix[row, "xyz".index(part[-1])] = -1.0 if part[0] == "-" else 1.0
    return matrix


def _split(steps: str) -> list[str]:
    """Return the steps of a reading; the plus of a factor such as 1e+3 divides none."""
    return re.split(r"(?<![0-9.][eE])\+", steps)


def _allowed(signal: str, step: str) -> bool:
    """Return whether `step` is a step of `signal`."""
    if step == "drop" or step in TIMES:
        return (step == "drop") != (signal == "time")
    if signal in QUATS:
        return step in _QUAT_STEPS
    if signal in MOTORS and _ORDER.match(step):
        return sorted(step.split(",")) == ["1", "2", "3", "4"]
    if signal in VECTORS and _AXES.match(step):
        return abs(np.linalg.det(axes_matrix(step))) == 1.0
    if step in ("from-body", "from-world"):
        return signal in ("vel", "rate", "acc")
    if step in ("plus-gravity", "1000-2000"):
        return signal in (("acc", "cmd_thrust") if step == "plus-gravity" else ("throttle", "pwm"))
    try:
        least = 0.0 if signal == "time" else -np.inf
        return least < float(step) < np.inf and float(step) != 0.0
    except ValueError:
        return False


def _turned(value: np.ndarray, step: str, quat: np.ndarray) -> np.ndarray:
    """Return vectors (N, 3) after a step that needs the attitude `quat` (N, 4)."""
    if step == "plus-gravity":
        return value + rotate(conjugate(quat), np.array([0.0, 0.0, GRAVITY]))
    return rotate(quat if step == "from-body" else conjugate(quat), value)


def _quat_as(value: np.ndarray, step: str) -> np.ndarray:
    """Return quaternions (N, 4) wxyz after a step."""
    if step == "xyzw":
        return value[:, [3, 0, 1, 2]]
    if step == "wxyz":
        return value[:, [1, 2, 3, 0]]
    if step.startswith("ned-"):
        return _quat_as(value * QUAT_HALF_TURN, step.removeprefix("ned-")) * QUAT_HALF_TURN
    if step == "inverse":
        return conjugate(value)
    if step == "ned":
        return multiply(np.broadcast_to(_HALF, value.shape), value)
    if step == "frd":
        return multiply(value, np.broadcast_to(_HALF, value.shape))
    from scipy.spatial.transform import Rotation

    known = np.isfinite(value).all(axis=1) & (np.linalg.norm(value, axis=1) > 0.0)
    angles = np.zeros((len(value), 3))
    angles[known] = Rotation.from_quat(value[known], scalar_first=True).as_euler("ZYX")[:, ::-1]
    angles[:, ANGLES.index(step)] *= -1.0
    return np.where(known[:, None], from_euler(angles), np.nan)

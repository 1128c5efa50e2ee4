"""Flights on a fine grid, on which what drives them can be late by any part of a row.

Their equations are compared in the smooth bumps of `data/view.py`, as those of the views are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from eval.importers.rows import held
from eval.importers.signals import Signal
from eval.logs.flight_log import FlightLog
from suite.diagnose.data.flights import leaning, turning_of
from suite.diagnose.data.inertial import specific_force_w
from suite.diagnose.data.noise import noise_like
from suite.diagnose.data.sampling import on_one_side
from suite.diagnose.data.view import FlightRows, WeakForm, weak_form
from tracks.geometry.rotation import quat_to_rot, rot_to_quat

STEP_S = 0.004
"""Of the grid [s]."""
MEMORY_S = 0.4
"""What was commanded longer ago than this acts no more [s]."""
HOLE_STEPS = 4.0
"""Rows further apart than so many median steps are a hole, over which nothing is compared."""
ROTOR_NOISE = "rotor_noise"
"""A draw of noise as large as that of the rotor speeds' rows: what it does to a window theirs does
as well."""
LEANING = "leaning"
"""The attitude of the path, where none was measured."""
IMU_ACC = "imu_acc_w"
"""The acceleration by the accelerometer, where no position was measured."""
PATH_VELOCITY = "path_velocity"
"""The velocity of the path, where none was measured."""
VOLTAGE_S = 0.04
"""The voltage's noise is averaged over about this [s]."""


class FlightGrid(NamedTuple):
    """One flight at G times, every `STEP_S`; NaN where it is not known."""

    name: str
    time_s: np.ndarray
    """(G,)."""
    known: dict[str, np.ndarray]
    """Signals (G, ...) by name: rot_w, vel_w, pos_w, rate_b, and what drives."""
    in_turn: tuple[str, ...] = ()
    """Those of which a row has some columns only, as of motors polled one after another."""

    def has(self, *names: str) -> bool:
        """Return whether these signals are there."""
        return all(name in self.known for name in names)

    def form(self, width_s: float, needs: Sequence[str], slope: bool = False) -> WeakForm:
        """Return bumps of `width_s` in which all of `needs` is known; `slope` as `weak_form` has.

        They begin a while after the first row: what was commanded before it still acts then.
        """
        good = self.time_s >= MEMORY_S
        for name in needs:
            values = self.known[name]
            good &= np.isfinite(values.reshape(len(values), -1)).all(axis=1)
        return weak_form(self.time_s, good, width_s, np.inf, slope)

    def rows(self, turned: bool) -> FlightRows:
        """Return the grid as rows of a view, without rotor speeds and with zeros for NaN.

        Args:
            turned: the attitude counts although it may be one of the path, whose yaw is none.
        """
        attitude = self.known.get("rot_w", self.known.get(LEANING) if turned else None)
        count, still = len(self.time_s), np.zeros((len(self.time_s), 3))
        volts = self.known.get("voltage", np.zeros(count))
        vel_w = self.known.get("vel_w", self.known.get(PATH_VELOCITY, still))
        if attitude is None:  # a velocity in unknown axes acts on nothing
            attitude, vel_w = np.broadcast_to(np.eye(3), (count, 3, 3)), still
        measured = (self.known.get("pos_w", still), attitude, vel_w)
        pos_w, rot_w, vel_w, rate_b = map(
            np.nan_to_num, (*measured, self.known.get("rate_b", still))
        )
        speed, good = np.zeros((count, 4)), np.ones(count, dtype=bool)
        drop = volts[0] - volts
        return FlightRows(self.time_s, pos_w, rot_w, vel_w, rate_b, speed, drop, good)


def grid_of(log: FlightLog) -> FlightGrid:
    """Return `log` on the grid."""
    imu_acc_w = specific_force_w(log)
    time_s = log.time_s - log.time_s[0]
    grid = np.arange(0.0, time_s[-1], STEP_S)
    known: dict[str, np.ndarray] = {}
    measured = {
        "pos_w": log.pos_w,
        "vel_w": None if log.velocity_derived else log.vel_w,
        IMU_ACC: imu_acc_w,
        "rate_b": log.rate_b,
        "rotor_speed": log.rotor_speed,
    }
    commanded = {
        "pwm": log.pwm,
        "thrust_cmd": log.thrust_cmd,
        "rate_cmd_b": log.rate_cmd_b,
        "torque_cmd_b": log.torque_cmd_b,
        "rotor_speed_cmd": log.rotor_speed_cmd,
    }
    there = {name: v for name, v in (measured | commanded).items() if v is not None and _enough(v)}
    in_turn = tuple(name for name, values in there.items() if _whole_rows(values) < 2)
    for name, values in there.items():
        known[name] = (joined if name in measured else _held)(time_s, values, grid)
    if "rotor_speed" in there:
        known[ROTOR_NOISE] = joined(time_s, noise_like(there["rotor_speed"]), grid)
    if "pos_w" in known and "vel_w" not in known:
        known[PATH_VELOCITY] = _slope(known["pos_w"])
    if _whole_rows(log.quat_wxyz) > 1:
        known["rot_w"] = attitude_on(time_s, log.quat_wxyz, grid)
        turning = turning_of(time_s, log.quat_wxyz)
        if "rate_b" not in known and _enough(turning):
            known["rate_b"] = joined(time_s, turning, grid)
    elif {"pos_w", "vel_w"} & {*known}:
        known[LEANING] = attitude_on(time_s, np.asarray(rot_to_quat(leaning(log))), grid)
    if log.voltage is not None and _enough(log.voltage):
        good = np.isfinite(log.voltage)
        volts = np.interp(grid, time_s[good], log.voltage[good])
        known["voltage"] = _smoothed(volts, round(VOLTAGE_S / STEP_S))
    return FlightGrid(log.name, grid, known, in_turn)


def _enough(values: np.ndarray) -> bool:
    """Return whether every column has two rows at least, between which something is known."""
    return bool(np.all(np.isfinite(values).sum(axis=0) > 1))


def _whole_rows(values: np.ndarray) -> int:
    return int(np.isfinite(values.reshape(len(values), -1)).all(axis=1).sum())


def joined(time_s: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return `values` (T, C) joined by lines, each column over the rows that have it.

    (G, C) on `grid`, NaN in holes and beyond a column's rows.
    """
    out = np.empty((len(grid), values.shape[1]))
    for k, column in enumerate(values.T):
        good = np.isfinite(column)
        out[:, k] = np.interp(grid, time_s[good], column[good])
        out[_in_hole(time_s[good], grid), k] = np.nan
    return out


def attitude_on(time_s: np.ndarray, quat: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return attitudes (G, 3, 3) of quaternions (T, 4), as `joined`."""
    found = joined(time_s, on_one_side(quat), grid)
    return quat_to_rot(found / np.linalg.norm(found, axis=1, keepdims=True))


def _slope(pos_w: np.ndarray) -> np.ndarray:
    """Return the velocity (G, 3) over 0.1 s of a path, for forces that go with it."""
    reach = round(0.05 / STEP_S)
    out = np.full_like(pos_w, np.nan)
    out[reach:-reach] = (pos_w[2 * reach :] - pos_w[: -2 * reach]) / (2 * reach * STEP_S)
    return out


def _held(time_s: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return what is held from row to row as its means from grid point to grid point.

    A row's stamp is mostly between two of them: taken at the points it would come late.
    """
    wide = np.asarray(values.reshape(len(values), -1), dtype=float)
    ends, out = np.append(grid, grid[-1] + STEP_S), np.empty((len(grid), wide.shape[1]))
    for k, column in enumerate(wide.T):
        good = np.isfinite(column)
        rows = Signal(time_s[good], column[good, None])
        out[:, k] = held(rows, ends)[:-1, 0]
        out[_in_hole(rows.time_s, grid), k] = np.nan
    return out.reshape(len(grid), *values.shape[1:])


def _in_hole(t: np.ndarray, grid: np.ndarray) -> np.ndarray:
    wide = np.diff(t) > HOLE_STEPS * float(np.median(np.diff(t)))
    at = np.clip(np.searchsorted(t, grid, side="right") - 1, 0, len(t) - 2)
    return wide[at] | (grid < t[0]) | (grid > t[-1])


def _smoothed(values: np.ndarray, count: int) -> np.ndarray:
    count = max(1, min(count, len(values) // 4)) | 1
    padded = np.pad(values, count // 2, mode="edge")
    return np.convolve(padded, np.full(count, 1.0 / count), mode="valid")

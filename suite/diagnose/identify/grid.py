"""Flights on a fine grid, and smooth windows in which their equations are compared.

An equation of motion is multiplied by a smooth window and integrated (modulating functions;
Shinbrot 1957): `mean(dv/dt)` over a window `p` is `-mean over p' (v)`, so that nothing noisy is
differentiated, and both sides are smoothed alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from eval.importers.rows import held
from eval.importers.signals import Signal
from eval.logs.flight_log import FlightLog
from suite.diagnose.data.noise import noise_like
from tracks.geometry.rotation import quat_to_rot

STEP_S = 0.004
"""Of the grid [s]."""
MEMORY_S = 0.4
"""What was commanded longer ago than this acts no more [s]."""
HOLE_STEPS = 4.0
"""Rows further apart than so many median steps are a hole, over which nothing is compared."""
ROTOR_NOISE = "rotor_noise"
"""A draw of noise as large as that of the rotor speeds' rows: what it does to a window theirs does
as well."""
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
    """Those of which a row has some columns only, as of motors that are asked one after another."""

    def has(self, *names: str) -> bool:
        """Return whether these signals are there."""
        return all(name in self.known for name in names)


class Windows(NamedTuple):
    """K windows of one flight."""

    first: np.ndarray
    """(K,) index of each window's first grid point."""
    weight: np.ndarray
    """(W,) of the window; they sum to 1."""
    slope: np.ndarray
    """(W,) of the mean of a signal's derivative."""
    bend: np.ndarray
    """(W,) of the mean of its second derivative."""

    @property
    def middle(self) -> np.ndarray:
        """(K,) index of each window's middle."""
        return self.first + len(self.weight) // 2


def grid_of(log: FlightLog) -> FlightGrid:
    """Return `log` on the grid."""
    time_s = log.time_s - log.time_s[0]
    grid = np.arange(0.0, time_s[-1], STEP_S)
    known: dict[str, np.ndarray] = {}
    measured = {
        "pos_w": log.pos_w,
        "vel_w": None if log.velocity_derived else log.vel_w,
        "rate_b": log.rate_b,
        "rotor_speed": log.rotor_speed,
    }
    asked = {
        "pwm": log.pwm,
        "thrust_cmd": log.thrust_cmd,
        "rate_cmd_b": log.rate_cmd_b,
        "torque_cmd_b": log.torque_cmd_b,
        "rotor_speed_cmd": log.rotor_speed_cmd,
    }
    there = {name: v for name, v in (measured | asked).items() if v is not None and _enough(v)}
    in_turn = tuple(name for name, values in there.items() if _whole_rows(values) < 2)
    for name, values in there.items():
        known[name] = (_joined if name in measured else _held)(time_s, values, grid)
    if "rotor_speed" in there:
        known[ROTOR_NOISE] = _joined(time_s, noise_like(there["rotor_speed"]), grid)
    if _whole_rows(log.quat_wxyz) > 1:
        known["rot_w"] = quat_to_rot(_attitude(time_s, log.quat_wxyz, grid))
        turning = _turning(time_s, log.quat_wxyz)
        if "rate_b" not in known and _enough(turning):
            known["rate_b"] = _joined(time_s, turning, grid)
    if log.voltage is not None and _enough(log.voltage):
        good = np.isfinite(log.voltage)
        volts = np.interp(grid, time_s[good], log.voltage[good])
        known["voltage"] = _smoothed(volts, round(VOLTAGE_S / STEP_S))
    return FlightGrid(log.name, grid, known, in_turn)


def windows_of(flight: FlightGrid, width_s: float, needs: Sequence[str]) -> Windows:
    """Return windows of `width_s` that overlap by half, in which all of `needs` is known.

    They begin a while after the first row: what was asked of the rotors before it still acts then.
    """
    count = 2 * round(0.5 * width_s / STEP_S) + 1
    turn = 2.0 * np.pi / (count - 1)
    phase = turn * np.arange(count)
    weight = 1.0 - np.cos(phase)
    scale = 1.0 / weight.sum()
    first = np.arange(round(MEMORY_S / STEP_S), len(flight.time_s) - count, count // 2)
    good = np.ones(len(flight.time_s), dtype=bool)
    for name in needs:
        values = flight.known[name]
        good &= np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    bad = np.concatenate([[0], np.cumsum(~good)])
    whole = bad[first + count] == bad[first]
    # Exact on lines and parabolas, so that where a signal is adds nothing to how it bends.
    time_s = STEP_S * (np.arange(count) - count // 2)
    slope, bend = -np.sin(phase), np.cos(phase)
    bend[[0, -1]] *= 0.5
    slope, bend = slope / (slope @ time_s), 2.0 * bend / (bend @ time_s**2)
    return Windows(first[whole], scale * weight, slope, bend)


def over(windows: Windows, values: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """Return the weighted sums (K, ...) of `values` (G, ...) over the windows."""
    weight = windows.weight if weight is None else weight
    at = windows.first[:, None] + np.arange(len(weight))
    return np.tensordot(np.moveaxis(values[at], 1, -1), weight, axes=([-1], [0]))


def blocks_of(flight: FlightGrid, windows: Windows, length_s: float) -> np.ndarray:
    """Return the number of the block of `length_s` that each window's middle is in, (K,)."""
    return (flight.time_s[windows.middle] / length_s).astype(int)


def _enough(values: np.ndarray) -> bool:
    """Return whether every column has two rows at least, between which something is known."""
    return bool(np.all(np.isfinite(values).sum(axis=0) > 1))


def _whole_rows(values: np.ndarray) -> int:
    return int(np.isfinite(values.reshape(len(values), -1)).all(axis=1).sum())


def _joined(time_s: np.ndarray, values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return `values` (T, C) joined by lines, each column over the rows that have it."""
    out = np.empty((len(grid), values.shape[1]))
    for k, column in enumerate(values.T):
        good = np.isfinite(column)
        out[:, k] = np.interp(grid, time_s[good], column[good])
        out[_in_hole(time_s[good], grid), k] = np.nan
    return out


def _attitude(time_s: np.ndarray, quat: np.ndarray, grid: np.ndarray) -> np.ndarray:
    good = np.isfinite(quat).all(axis=1)
    t, q = time_s[good], quat[good]
    flips = np.sum(q[1:] * q[:-1], axis=1) < 0
    q = q * np.concatenate([[1.0], np.where(np.cumsum(flips) % 2, -1.0, 1.0)])[:, None]
    out = np.stack([np.interp(grid, t, column) for column in q.T], axis=1)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    out[_in_hole(t, grid)] = np.nan
    return out


def _turning(time_s: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Return the body rates (T, 3) from each row's neighbours; NaN where one is missing."""
    from scipy.spatial.transform import Rotation

    rate_b = np.full((len(quat), 3), np.nan)
    whole = np.asarray(np.isfinite(quat).all(axis=1))
    rows = 1 + np.flatnonzero(whole[:-2] & whole[2:])
    if len(rows):
        before, after = (Rotation.from_quat(quat[rows + d][:, [1, 2, 3, 0]]) for d in (-1, 1))
        step_s = (time_s[rows + 1] - time_s[rows - 1])[:, None]
        rate_b[rows] = (before.inv() * after).as_rotvec() / step_s
    return rate_b


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

"""Resamples a flight log on a grid of 4 ms, for the fits of `suite identify`.

On so fine a grid, a command can be delayed by a fraction of a log row. The fits compare measured
and modelled accelerations as weighted means over short windows (`data/view.py`, the weak form).

T is the number of rows of a log, G the number of grid points, and C the number of columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from eval.effects.interface import GRAVITY
from eval.importers.rows import held
from eval.importers.signals import Signal
from eval.logs.flight_log import FlightLog
from eval.quadrotor.plant import Motion
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.flights import leaning, turning_of
from suite.diagnose.data.inertial import InertialLog, specific_force_w
from suite.diagnose.data.noise import noise_like
from suite.diagnose.data.sampling import (
    HELD,
    MEASURED,
    attitude_at,
    in_hole,
    interpolate,
    on_every_row,
    own_spacing_s,
)
from suite.diagnose.data.view import FlightRows, WeakForm, near_ground, weak_form
from tracks.geometry.rotation import rot_to_quat

STEP_S = 0.004
"""Step of the grid [s]."""
MEMORY_S = 0.4
"""Commands older than this have no effect [s]."""
ROTOR_NOISE = "rotor_noise"
"""Signal: noise like that of the measured rotor speeds, added to see its influence."""
LEANING = "leaning"
"""Name of a signal: the attitude that the path's acceleration requires, if none was measured."""
IMU_ACC = "imu_acc_w"
"""Name of a signal: acceleration by the accelerometer, if no position was measured."""
POSE_SLOPE = "pose_slope_b"
"""Signal: change of the drag by each uncertainty of a pose by inertia, (G, 3 K): `InertialLog`."""
VELOCITY_NOISE = "vel_noise_b"
"""Signal: draws of the error of a velocity by inertia, (G, 3 D): `InertialLog`."""
VOLTAGE_STEPS = 11
"""The voltage is averaged over this many steps of the grid, to reduce its noise."""


class FlightGrid(NamedTuple):
    """One flight at G times, `STEP_S` apart; NaN where a signal is missing."""

    name: str
    time_s: np.ndarray
    """(G,) time from the first row of the flight [s]."""
    signals: dict[str, np.ndarray]
    """Signals (G, ...) by name: rot_w, vel_w, pos_w, rate_b, commands and rotor speeds."""
    in_turn: tuple[str, ...] = ()
    """Signals of which each row has only some columns, such as motors that are read in turn."""
    rotor_spacing_s: float = 0.0
    """Time between the measured rotor speeds [s]; 0 without any."""
    on_ground: np.ndarray | None = None
    """(G,) bool, whether the vehicle is on the ground or near it in time; None: never."""

    def has(self, *names: str) -> bool:
        """Return whether the flight has all of these signals."""
        return all(name in self.signals for name in names)

    def form(self, width_s: float, needs: Sequence[str], slope: bool = False) -> WeakForm:
        """Return the weights of the windows of `width_s` with all signals of `needs`.

        For `slope` see `weak_form`. No window begins in the first `MEMORY_S`, where commands from
        before the first row still act, and none is on the ground.
        """
        good = self.time_s >= MEMORY_S
        if self.on_ground is not None:
            good &= ~self.on_ground
        for name in needs:
            values = self.signals[name]
            good &= np.isfinite(values.reshape(len(values), -1)).all(axis=1)
        return weak_form(self.time_s, good, width_s, np.inf, slope)

    def rows(self, attitude_of_path: bool) -> FlightRows:
        """Return the grid as rows of a view, with zeros for rotor speeds and for missing values.

        With `attitude_of_path`, a missing attitude is `LEANING`, whose yaw is arbitrary.
        """
        signals, count = self.signals, len(self.time_s)
        zeros, no_speed, good = np.zeros((count, 3)), np.zeros((count, 4)), np.ones(count, bool)
        pos_w, vel_w, rate_b = (signals.get(name, zeros) for name in ("pos_w", "vel_w", "rate_b"))
        attitude = signals.get("rot_w", signals.get(LEANING) if attitude_of_path else None)
        if attitude is None:  # without an attitude the velocity in body axes is unknown
            attitude, vel_w = np.broadcast_to(np.eye(3), (count, 3, 3)), zeros
        motion = Motion(*map(np.nan_to_num, (pos_w, attitude, vel_w, rate_b)))
        volts = signals.get("voltage", np.zeros(count))
        return FlightRows(self.time_s, motion, no_speed, volts[0] - volts, good)


def grid_of(log: FlightLog) -> FlightGrid:
    """Return `log` on the grid: measurements interpolated, commands held from row to row."""
    time_s = log.time_s - log.time_s[0]
    grid_s = np.arange(0.0, time_s[-1], STEP_S)
    values = {name: getattr(log, name) for name in (*MEASURED, *HELD)}
    values[IMU_ACC] = specific_force_w(log)
    quat_wxyz = values.pop("quat_wxyz")
    logged = {name: v for name, v in values.items() if v is not None and _enough(v)}
    in_turn = tuple(name for name, values in logged.items() if _complete_rows(values) < 2)
    signals: dict[str, np.ndarray] = {}

    def add_measured(name: str, values: np.ndarray) -> None:
        signals[name] = interpolate(grid_s, time_s, values, holes=True)

    # Resample them, and derive those that were not measured.
    for name, values in logged.items():
        if name in HELD:
            signals[name] = _held(time_s, values, grid_s)
        else:
            add_measured(name, values)
    if isinstance(log, InertialLog):
        for name, of_pose in ((POSE_SLOPE, log.pose_slope_b), (VELOCITY_NOISE, log.vel_noise_b)):
            assert of_pose is not None
            add_measured(name, of_pose.reshape(len(time_s), -1))
            signals[name] = np.nan_to_num(signals[name])
    if "rotor_speed" in logged:
        add_measured(ROTOR_NOISE, noise_like(logged["rotor_speed"]))
    if _complete_rows(quat_wxyz) > 1:
        signals["rot_w"] = attitude_at(grid_s, time_s, quat_wxyz)
        rate_b = turning_of(time_s, quat_wxyz)
        if "rate_b" not in signals and _enough(rate_b):
            add_measured("rate_b", rate_b)
    elif "vel_w" in signals:
        lean = np.asarray(rot_to_quat(leaning(log)))
        signals[LEANING] = attitude_at(grid_s, time_s, lean)
    if log.voltage is not None and _enough(log.voltage):
        volts = interpolate(grid_s, time_s, log.voltage[:, None])[:, 0]
        signals["voltage"] = uniform_filter1d(volts, VOLTAGE_STEPS, mode="nearest")
    spacing_s = own_spacing_s(time_s, logged["rotor_speed"]) if "rotor_speed" in logged else 0.0
    return FlightGrid(log.name, grid_s, signals, in_turn, spacing_s)


def with_ground(
    flight: FlightGrid, log: FlightLog, vehicle: Vehicle, drive_signal: str
) -> FlightGrid:
    """Return `flight`, the grid of `log`, with the times at which `vehicle` is on the ground.

    The thrust is that of `drive_signal`, relative to its usual size in flight: the thrust by the
    vehicle file may be wrong.
    """
    state = on_every_row(log)
    signal = np.asarray(getattr(state, drive_signal)).reshape(len(log.time_s), -1)
    effort = (signal**2 if drive_signal == "rotor_speed" else signal).sum(axis=1)
    known = effort[np.isfinite(effort)]
    usual = np.median(known[known >= 0.5 * np.quantile(known, 0.95)]) if len(known) else 0.0
    if not usual > 0.0:
        return flight
    # Rotor speeds that give this share of the weight.
    thrust = effort / usual * vehicle.mass * GRAVITY / 4.0
    speed = np.sqrt(np.maximum(thrust, 0.0) / vehicle.rotors.thrust_coefficient)
    near = near_ground(state, vehicle, np.repeat(speed[:, None], 4, axis=1))
    row = np.searchsorted(log.time_s - log.time_s[0], flight.time_s, side="right") - 1
    return flight._replace(on_ground=near[row])


def _enough(values: np.ndarray) -> bool:
    """Return whether every column has at least two rows, so that it can be interpolated."""
    return bool(np.all(np.isfinite(values).sum(axis=0) > 1))


def _complete_rows(values: np.ndarray) -> int:
    """Return the number of rows in which all columns are present."""
    return int(np.isfinite(values.reshape(len(values), -1)).all(axis=1).sum())


def _held(time_s: np.ndarray, values: np.ndarray, grid_s: np.ndarray) -> np.ndarray:
    """Return commands held from row to row, as means (G, ...) over each step of the grid.

    They change between grid points, so that their values there would be too late.
    """
    flat = np.asarray(values.reshape(len(values), -1), dtype=float)
    ends_s, out = np.append(grid_s, grid_s[-1] + STEP_S), np.empty((len(grid_s), flat.shape[1]))
    for k, column in enumerate(flat.T):
        good = np.isfinite(column)
        signal = Signal(time_s[good], column[good, None])
        out[:, k] = held(signal, ends_s)[:-1, 0]
        out[in_hole(grid_s, signal.time_s), k] = np.nan
    return out.reshape(len(grid_s), *values.shape[1:])

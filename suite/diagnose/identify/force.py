"""The force on the body: thrust by what drove the motors, and drag, under the measured attitude."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from eval.effects.interface import GRAVITY
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.identify.drive import MotorGuess, delayed, lagged, motor_thrusts, rotor_thrusts
from suite.diagnose.identify.fit import Fitted, Rows, Unknown, fit
from suite.diagnose.identify.grid import FlightGrid, blocks_of, over, windows_of

WIDTH_S = 0.4
BLOCK_S = 2.0
DRIVEN = {"pwm": "pwm", "rotors": "rotor_speed", "torques": "thrust_cmd", "rates": "thrust_cmd"}
LEVEL = np.array([True, True, False])
"""A flight's trim of the attitude is free; along z it would be the thrust."""


def unknowns_of(
    drive: str, guess: MotorGuess, voltage: bool, drag: Sequence[float]
) -> list[Unknown]:
    """Return the numbers of the force; their starts are those of the vehicle file."""
    unknowns = [Unknown("thrust", 0.0, -2.0, 2.0, 0.25, 1e-3, 0.001)]
    if drive == "pwm":
        unknowns.append(Unknown("curve", guess.curve, -0.1, 1.0, 0.35, 1e-2, 0.02))
        if voltage:
            unknowns.append(Unknown("battery", guess.battery, 0.0, 4.0, 0.6, 1e-2, 0.02))
    for axis, start in zip("xyz", drag, strict=True):
        unknowns.append(Unknown(f"drag_{axis}", start, -2.0, 5.0, 0.25, 1e-2, 0.004))
    return unknowns


def fit_force(
    flights: Sequence[FlightGrid],
    vehicle: Vehicle,
    drive: str,
    guess: MotorGuess,
    unknowns: Sequence[Unknown],
    lag_s: float,
    delay_s: float,
    fixed: Mapping[str, float],
) -> Fitted:
    """Return the thrust's and the drag's numbers.

    Args:
        flights: on their grids, with attitude and position.
        vehicle: mass, rotors.
        drive: one of `drive.DRIVES`.
        guess: of the motors, where `drive` is pwm.
        unknowns: from `unknowns_of`.
        lag_s: of the rotors [s].
        delay_s: of the commands [s].
        fixed: numbers that are not looked for.
    """
    names = [unknown.name for unknown in unknowns]
    prepared = [_prepared(flight, DRIVEN[drive]) for flight in flights]

    def misses(value: np.ndarray) -> list[Rows]:
        told = {**fixed, **dict(zip(names, value, strict=True))}
        out = []
        for flight, (windows, up_w, drag_b, felt, block) in zip(flights, prepared, strict=True):
            force = force_of(flight, vehicle, drive, guess, told, lag_s, delay_s)
            # Along the body's axes of the window's middle, so that a channel is an axis.
            pushed = np.einsum(
                "kji,kj->ki",
                flight.known["rot_w"][windows.middle],
                over(windows, up_w * force[:, None]),
            )
            drag = np.array([told.get(f"drag_{axis}", 0.0) for axis in "xyz"])
            out.append(Rows(felt - pushed + drag_b @ drag, block, LEVEL))
        return out

    return fit(misses, unknowns)


def force_of(
    flight: FlightGrid,
    vehicle: Vehicle,
    drive: str,
    guess: MotorGuess,
    told: Mapping[str, float],
    lag_s: float,
    delay_s: float,
) -> np.ndarray:
    """Return the collective thrust per mass (G,) [m/s^2] under the numbers `told`."""
    scale = float(np.exp(told.get("thrust", 0.0)))
    if drive == "pwm":
        return (
            scale
            * motor_thrusts(flight, with_told(guess, told), lag_s, delay_s).sum(axis=1)
            / vehicle.mass
        )
    if drive == "rotors":
        thrust = rotor_thrusts(flight, vehicle.rotors.thrust_coefficient)
        return scale * thrust.sum(axis=1) / vehicle.mass
    command = delayed(flight.known["thrust_cmd"], delay_s)
    return scale * lagged(np.sqrt(np.maximum(command, 0.0))[:, None], lag_s)[:, 0] ** 2


def with_told(guess: MotorGuess, told: Mapping[str, float]) -> MotorGuess:
    """Return the guess with the shape that was told; its size is the number `thrust`."""
    shape = {key: float(told[key]) for key in ("curve", "battery") if key in told}
    return guess._replace(**shape)


def _prepared(flight: FlightGrid, driven: str) -> tuple:
    """Return what does not change from trial to trial: windows, and the measured sides."""
    moved = "vel_w" if flight.has("vel_w") else "pos_w"
    windows = windows_of(flight, WIDTH_S, (moved, "rot_w", driven))
    if moved == "vel_w":
        acc_w = over(windows, flight.known["vel_w"], windows.slope)
        vel_w = flight.known["vel_w"]
    else:
        acc_w = over(windows, flight.known["pos_w"], windows.bend)
        vel_w = _velocity(flight.known["pos_w"])
    rot_w = flight.known["rot_w"]
    felt_w = acc_w + [0.0, 0.0, GRAVITY]
    felt = np.einsum("kji,kj->ki", rot_w[windows.middle], felt_w)
    vel_b = np.einsum("gji,gj->gi", rot_w, vel_w)
    # What a unit of drag along each body axis pushes, in the axes of the window's middle.
    pulled_w = over(windows, rot_w * np.nan_to_num(vel_b)[:, None, :])
    drag_b = np.einsum("kji,kjd->kid", rot_w[windows.middle], pulled_w)
    return windows, rot_w[:, :, 2], drag_b, felt, blocks_of(flight, windows, BLOCK_S)


def _velocity(pos_w: np.ndarray) -> np.ndarray:
    """Return the slope over 0.1 s, for the drag only."""
    from suite.diagnose.identify.grid import STEP_S

    reach = round(0.05 / STEP_S)
    out = np.full_like(pos_w, np.nan)
    out[reach:-reach] = (pos_w[2 * reach :] - pos_w[: -2 * reach]) / (2 * reach * STEP_S)
    return out

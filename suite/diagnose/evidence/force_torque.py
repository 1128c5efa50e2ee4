"""What the vehicle's equations say of force and torque on measured rows, and along every number."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.effects import EFFECTS
from eval.effects.interface import Sample
from eval.effects.log_faults import restored
from eval.quadrotor.plant import Motion, accelerations, assemble, nominal_quadrotor
from eval.quadrotor.rotors import steady
from eval.quadrotor.stepper import Inputs, wind_and_flow, wrench_on
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.steps import LONGEST_S
from suite.diagnose.data.view import FlightRows
from suite.diagnose.estimate.parameters import ParameterLayout, ParameterSpace, effects_at
from suite.diagnose.evidence.rollout_model import VehicleArrays, grouped

CHUNK = 1024
"""Rows a call: one shape, compiled once."""


class RowForces(NamedTuple):
    """What the equations say of N rows."""

    value: np.ndarray
    """(N, 6) dv/dt in the world [m/s^2] and dw/dt in body axes [rad/s^2]."""
    slope: np.ndarray
    """(N, 6, K) along numbers."""


class ForceModel:
    """A vehicle's accelerations under measured attitude, velocity, rates and rotor speeds."""

    def __init__(self, vehicle: Vehicle, space: ParameterSpace, voltage: bool) -> None:
        """Prepare `vehicle` with the numbers of `space`; `voltage`: whether the rows have one."""
        self.space = space
        base = {name: v for name, v in space.base.items() if EFFECTS[name].by_state}
        self._given = VehicleArrays(*nominal_quadrotor(vehicle), base)
        self._compiled = _forces(space.layout, voltage)

    def at(
        self, theta: np.ndarray, rows: FlightRows, indices: Sequence[int] | None = None
    ) -> RowForces:
        """Return what acts at the numbers `theta` (P,), and how it changes along each of `indices`.

        Along all numbers if not given.
        """
        count, everything = len(rows.time_s), np.eye(len(theta))
        directions = [everything] if indices is None else grouped(everything, indices)
        asked = len(theta) if indices is None else len(indices)
        values, slopes = [], []
        with jax.enable_x64(True):
            for first in range(0, count, CHUNK):
                at = np.minimum(np.arange(first, first + CHUNK), count - 1)
                part = FlightRows(*(np.asarray(field)[at] for field in rows))
                said = [self._compiled(self._given, theta, part, group) for group in directions]
                values.append(np.asarray(said[0][0])[: count - first])
                slope = np.concatenate([np.asarray(each) for _, each in said], axis=-1)
                slopes.append(slope[: count - first, :, :asked])
        return RowForces(np.concatenate(values), np.concatenate(slopes))


@cache
def _forces(layout: ParameterLayout, voltage: bool) -> Callable[..., Any]:
    """Return the compiled accelerations and their slopes, the same for every vehicle."""

    def act(given: VehicleArrays, theta: Any, rows: FlightRows) -> Any:
        values = effects_at(layout, given.base, theta)
        plant = assemble(given.nominal, given.constants, values, LONGEST_S, 0.0)
        logged = Sample(rows.pos_w, rows.rot_w, rows.vel_w, rows.rate_b, 0.0 * rows.rate_b)
        motion = Motion(*restored(values, logged)[:4])
        rotors = steady(rows.rotor_speed)
        inputs = Inputs(voltage_drop=rows.voltage_drop if voltage else None)
        _, flow = wind_and_flow(plant, {}, motion, rotors, inputs, rows.time_s)
        acc_w, turn_b = accelerations(plant, motion, wrench_on(plant, rotors, flow))
        return jnp.concatenate([acc_w, turn_b], axis=-1)

    def both(given: VehicleArrays, theta: Any, rows: FlightRows, directions: Any) -> Any:
        def along(direction: Any) -> Any:
            return jax.jvp(lambda t: act(given, t, rows), (theta,), (direction,))

        return jax.vmap(along, out_axes=(None, -1))(directions)

    return jax.jit(both)

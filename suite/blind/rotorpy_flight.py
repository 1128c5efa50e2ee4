"""Commanded trajectories flown in RotorPy, another simulator with equations of its own.

Tracking controller, rate loop and mixer are ours, since the vehicle file describes them; rotors,
air and rigid body are RotorPy's, as in the simulator `rotorpy`.

RotorPy's rotor drag and inflow depend on each hub's airspeed `v + w x r`, those of our catalogue on
the body's. At rotor speed `Omega` the difference is an angular damping: a drag `k Omega` in the
rotor plane turns against `w_z` by `k Omega (x^2 + y^2)` a rotor, an inflow along body z against
`w_x` by `k Omega y^2` and against `w_y` by `k Omega x^2`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eval.effects.interface import GRAVITY
from eval.flights.follow import Recording, Step, follow, reference_of
from eval.flights.simulate import FULL_V
from eval.flights.trajectory import Reference, Trajectory
from eval.quadrotor.plant import Command, Motion, Wrench, make_plant
from eval.quadrotor.stepper import wanted_speed
from eval.vehicles.vehicle import Vehicle
from eval.worlds.rotorpy import Multirotor, Push
from eval.worlds.rotorpy_vehicle import ROTORPY_EFFECTS
from tracks.geometry.rotation import quat_to_rot


def check_effects(truth: Vehicle) -> None:
    """Refuse a vehicle with an effect that RotorPy does not have in the same form.

    Raises:
        ValueError: with the effect and what is allowed.
    """
    for name in truth.effects:
        if name not in ROTORPY_EFFECTS:
            raise ValueError(
                f"effects.{name}: RotorPy does not have it; allowed: {', '.join(ROTORPY_EFFECTS)}"
            )


def fly_rotorpy(
    nominal: Vehicle, truth: Vehicle, trajectories: Sequence[Trajectory], rate_hz: float
) -> list[Recording]:
    """Fly `trajectories` side by side in RotorPy; the arguments are those of `fly`.

    Raises:
        FlightFailed: if a flight tips over, touches the ground or leaves its trajectory.
        ValueError: for an effect that RotorPy does not have, and if it is not installed.
    """
    check_effects(truth)
    frequency = nominal.controller.frequency
    dt, period = 1.0 / frequency, round(frequency / rate_hz)
    wanted = reference_of(trajectories, period, dt)
    bodies = _RotorpyBodies(nominal, truth, wanted, dt)
    return follow(bodies, nominal, trajectories, wanted, period, dt)


class _RotorpyBodies:
    """RotorPy's multirotors with our rate loop; their logs count as continuous in time."""

    integrator: str | None = None

    def __init__(self, nominal: Vehicle, truth: Vehicle, wanted: Reference, dt: float) -> None:
        count = wanted.yaw.shape[1]
        half, none = wanted.yaw[0] / 2, np.zeros(count)
        quat = np.stack([np.cos(half), none, none, np.sin(half)], axis=-1)
        self._plant = make_plant(nominal, dt)
        self._multirotor = Multirotor(truth, dt, count)
        self._qpos = np.concatenate([wanted.pos_w[0], quat], axis=-1)
        self._qvel = np.concatenate([wanted.vel_w[0], np.zeros((count, 3))], axis=-1)
        hover = Command(np.full(count, GRAVITY), np.zeros((count, 3)))
        self._speed = wanted_speed(self._plant, hover, np.zeros((count, 3)))
        self._still = np.zeros((count, 3))

    def motion(self) -> tuple[Motion, np.ndarray]:
        quat = self._qpos[:, 3:]
        rot_w = quat_to_rot(quat)
        return Motion(self._qpos[:, :3], rot_w, self._qvel[:, :3], self._qvel[:, 3:]), quat

    def step(self, motion: Motion, command: Command, time_s: float) -> Step:
        speed = self._speed
        push = Push(wanted_speed(self._plant, command, motion.rate_b), self._still)
        self._qpos, self._qvel, self._speed = self._multirotor.step(
            self._qpos, self._qvel, speed, push
        )
        acc_b = self._multirotor.specific_force_b(self._qpos, self._qvel, self._speed)
        voltage = np.full(len(speed), FULL_V)
        return Step(speed, voltage, command, Wrench(self._still, self._still), acc_b)


NAME = "angular_damping"
WITHIN = 1.5
"""Largest ratio of a named damping to that of moving hubs in hover, since flights are no hover."""


def damping_of_hubs(effects: Sequence[Mapping[str, Any]], vehicle: Vehicle) -> np.ndarray:
    """Return the damping (3,) by moving hubs in hover that an answer's `effects` cause [1/s]."""
    place = np.asarray(vehicle.rotors.position)
    inertia = np.asarray(vehicle.inertia)
    thrust = vehicle.mass * GRAVITY / len(place)
    speed = np.sqrt(thrust / vehicle.rotors.thrust_coefficient)
    x_sum, y_sum = (place[:, :2] ** 2).sum(axis=0) * speed
    found = np.zeros(3)
    for effect in effects:
        if effect["name"] == "rotor_drag":
            found[2] += effect["parameters"]["coefficient"] * (x_sum + y_sum)
        if effect["name"] == "inflow":
            found[:2] += effect["parameters"]["coefficient"] * np.array([y_sum, x_sum])
    return found / inertia


def is_of_hubs(effect: Mapping[str, Any], damping: np.ndarray) -> bool:
    """Return whether a diagnosis' `effect` is the damping (3,) by moving hubs."""
    if effect["name"] != NAME or effect.get("alternatives") or not damping.any():
        return False
    value = np.asarray(effect["parameters"]["coefficient"]["value"], float)
    most = int(damping.argmax())
    ratio = value[most] / damping[most]
    return bool(1.0 / WITHIN <= ratio <= WITHIN) and int(value.argmax()) in np.flatnonzero(damping)

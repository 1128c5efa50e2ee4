"""Fly trajectories of blind cases in RotorPy, a simulator with different equations.

Tracking controller, rate loop and mixer are those of the suite, since the vehicle file describes
them. RotorPy simulates rotors, air and rigid body, as in the simulator `rotorpy`.

The effects rotor drag and inflow depend on an airspeed. In the catalogue it is the airspeed of the
body. In RotorPy it is that of each hub (centre of a rotor), `v + w x r`, which also moves as the
body turns. The difference is an angular damping, here "damping by moving hubs". With the rotor
speed `Omega` and the hub at (x, y), a rotor drag `k Omega` damps `w_z` by
`k Omega (x^2 + y^2)`. An inflow along body z damps `w_x` by `k Omega y^2` and `w_y` by
`k Omega x^2`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from eval.effects.interface import GRAVITY
from eval.flights.follow import Recording, Step, follow, reference_of
from eval.flights.simulate import FULL_V
from eval.flights.trajectory import Reference, Trajectory
from eval.quadrotor.plant import Command, Motion, make_plant
from eval.quadrotor.stepper import wanted_speed
from eval.vehicles.vehicle import Vehicle, with_effects
from eval.worlds.rotorpy import Multirotor, StepInput
from eval.worlds.rotorpy_vehicle import ROTORPY_EFFECTS, hover_speed, rotorpy_parameters
from tracks.geometry.rotation import quat_to_rot

DAMPING = "angular_damping"
"""Effect of the catalogue that a diagnosis may name because of the damping by moving hubs."""
WITHIN = 1.5
"""Largest factor between a named damping and the damping by moving hubs in hover. They differ,
because the rotor speeds in a flight differ from those in hover."""


def fly_rotorpy(
    nominal: Vehicle, truth: Vehicle, trajectories: Sequence[Trajectory], rate_hz: float
) -> list[Recording]:
    """Fly `trajectories` in parallel in RotorPy.

    The tracking controller, the rate loop and the mixer use the constants of the `nominal` vehicle;
    the `truth` flies. The records have `rate_hz` rows per second [Hz].

    Returns:
        The records of the flights.

    Raises:
        FlightFailed: if a flight tips over, touches the ground or leaves its trajectory.
        ValueError: for an effect that RotorPy does not have in the same form, and if it is not
            installed.
    """
    for name in truth.effects:
        if name not in ROTORPY_EFFECTS:
            raise ValueError(
                f"effects.{name}: RotorPy does not have it; allowed: {', '.join(ROTORPY_EFFECTS)}"
            )
    frequency = nominal.controller.frequency
    dt, period = 1.0 / frequency, round(frequency / rate_hz)
    reference = reference_of(trajectories, period, dt)
    bodies = _RotorpyBodies(nominal, truth, reference, dt)
    return follow(bodies, nominal, trajectories, reference, period, dt)


class _RotorpyBodies:
    """Multirotors of RotorPy with the rate loop of the suite, in the form that `follow` flies."""

    integrator: str | None = None
    """None: their logs count as continuous in time, not as steps of MuJoCo."""

    def __init__(self, nominal: Vehicle, truth: Vehicle, reference: Reference, dt: float) -> None:
        count = reference.yaw.shape[1]
        half_yaw, zeros = reference.yaw[0] / 2, np.zeros(count)
        quat = np.stack([np.cos(half_yaw), zeros, zeros, np.sin(half_yaw)], axis=-1)
        self._plant = make_plant(nominal, dt)
        self._multirotor = Multirotor(truth, dt, count)
        self._qpos = np.concatenate([reference.pos_w[0], quat], axis=-1)
        self._qvel = np.concatenate([reference.vel_w[0], np.zeros((count, 3))], axis=-1)
        hover = Command(np.full(count, GRAVITY), np.zeros((count, 3)))
        self._speed = wanted_speed(self._plant, hover, np.zeros((count, 3)))
        self._no_wind_w = np.zeros((count, 3))

    def motion(self) -> tuple[Motion, np.ndarray]:
        """Return the present motion, and the attitudes as quaternions wxyz (N, 4)."""
        quat = self._qpos[:, 3:]
        rot_w = quat_to_rot(quat)
        return Motion(self._qpos[:, :3], rot_w, self._qvel[:, :3], self._qvel[:, 3:]), quat

    def step(self, motion: Motion, command: Command, time_s: float) -> Step:
        """Advance all flights by one step, and return what a log of it has."""
        speed = self._speed
        push = StepInput(wanted_speed(self._plant, command, motion.rate_b), self._no_wind_w)
        self._qpos, self._qvel, self._speed = self._multirotor.step(
            self._qpos, self._qvel, speed, push
        )
        acc_b = self._multirotor.specific_force_b(self._qpos, self._qvel, self._speed)
        voltage = np.full(len(speed), FULL_V)
        return Step(speed, voltage, acc_b)


def hub_damping(effects: Sequence[Mapping[str, Any]], vehicle: Vehicle) -> np.ndarray:
    """Return the angular damping (3,) about body axes that moving hubs cause in hover [1/s].

    The true effects are those of a case's answer, the vehicle is that for the diagnosis. A rotor at
    r with the speed W has the force -W diag(k_d, k_d, k_z) (w x r) if the body turns at w. Its
    torque about the body's axes is divided by the inertia.
    """
    drags = {
        effect["name"]: EFFECTS[effect["name"]].values(effect["parameters"]["coefficient"])
        for effect in effects
        if effect["name"] in ("rotor_drag", "inflow")
    }
    parameters = rotorpy_parameters(with_effects(vehicle, drags))
    x2, y2, z2 = (np.array(list(parameters["rotor_pos"].values())) ** 2).sum(axis=0)
    drag, lift = parameters["k_d"], parameters["k_z"]
    torque = np.array([lift * y2 + drag * z2, lift * x2 + drag * z2, drag * (x2 + y2)])
    inertia = np.array([parameters[name] for name in ("Ixx", "Iyy", "Izz")])
    return hover_speed(parameters) * torque / inertia


def is_hub_damping(effect: Mapping[str, Any], damping: np.ndarray) -> bool:
    """Return whether the named `effect` of a diagnosis is the damping by moving hubs.

    It is if its name, its axis and its size agree with `damping` (3,), that in hover [1/s].
    """
    if effect["name"] != DAMPING or effect.get("alternatives") or not damping.any():
        return False
    value = np.asarray(effect["parameters"]["coefficient"]["value"], float)
    largest = int(damping.argmax())
    ratio = value[largest] / damping[largest]
    return bool(1.0 / WITHIN <= ratio <= WITHIN) and int(value.argmax()) in np.flatnonzero(damping)

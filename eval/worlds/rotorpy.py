"""The simulator `rotorpy`: RotorPy's multirotor flies the trials (Folk, Paulos and Kumar 2023).

The suite's own code runs the autopilot, rate loop and mixer, since a vehicle file describes them.
It also computes the policy, scene, images, contacts and rules. RotorPy's batched multirotor gets
the commanded rotor speeds. It simulates the first-order response (lag) of the rotors, thrust, drag,
air and rigid body. Its integrator is Runge-Kutta of order 4 with a fixed step, at the rate loop's
frequency. RotorPy's adaptive integrator is not used: it has one step size for all drones, so a
trial would depend on the other trials.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from eval.quadrotor.autopilot import AutopilotState, attitude_step, motor_speed_command
from eval.quadrotor.forces import winds_on
from eval.quadrotor.plant import Motion
from eval.quadrotor.stepper import rotor_command
from eval.vehicles.vehicle import Vehicle
from eval.worlds import rotorpy_vehicle
from eval.worlds.scene_slots import TO_CONTACTS, SceneSlots
from tracks.common.masks import make_contiguous
from tracks.geometry.rotation import quat_to_rot, to_local

XYZW = [1, 2, 3, 0]
"""Indices of x, y, z and w in a quaternion wxyz; RotorPy's are xyzw."""


def rotorpy() -> Any:
    """Return RotorPy's module of multirotors.

    Raises:
        ValueError: where RotorPy, or a package that its batched part needs, is not installed; the
            message has the command that installs it.
    """
    try:
        for package in ("torchdiffeq", "roma"):  # needed by RotorPy's batched part
            importlib.import_module(package)
        return importlib.import_module("rotorpy.vehicles.multirotor")
    except ModuleNotFoundError as error:
        raise ValueError(
            f"world 'rotorpy' needs the package {error.name!r}: "
            "pip install 'diffracing-suite[rotorpy]'"
        ) from error


class StepInput(NamedTuple):
    """Inputs of a step of RotorPy, constant during the step."""

    rotor_speed: np.ndarray
    """(N, 4) commanded rotor speeds [rad/s]."""
    wind_w: np.ndarray
    """(N, 3) wind [m/s]."""


class RotorpyWorld(SceneSlots):
    """RotorPy's own drone, `BatchedMultirotor`; the package is optional.

    It has no attribute `integrator`, so its flight logs count as continuous in time.
    """

    cost = 6.0
    """Computing time of a trial relative to MuJoCo's."""

    def __init__(self, vehicle: Vehicle, *arguments: Any, **settings: Any) -> None:
        """Make the world; the arguments are those of `SceneSlots`.

        Raises:
            ValueError: where RotorPy is not installed.
        """
        super().__init__(vehicle, *arguments, **settings)
        self._multirotor = Multirotor(vehicle, self.dt, self.slots)

    check = staticmethod(rotorpy)
    differences = staticmethod(rotorpy_vehicle.differences)
    nearest = staticmethod(rotorpy_vehicle.as_flown)

    def _control(
        self,
        motion: Motion,
        action_b: np.ndarray,
        gate_w: np.ndarray,
        step: np.ndarray,
        noise: np.ndarray | None,
    ) -> tuple[AutopilotState, StepInput]:
        """Return the autopilot's state, and the rotor speeds and wind for RotorPy."""
        loops = attitude_step(self._autopilot, self._loops, motion, action_b, gate_w, step)
        plant = self._autopilot.plant
        motor_action = motor_speed_command(self._autopilot, action_b)
        state, speed_cmd = rotor_command(
            plant, loops.plant, loops.command, motion.rate_b, motor_action
        )
        winds, air_vel_w = winds_on(plant, state.wind, motion, noise)
        loops = make_contiguous(loops._replace(plant=state._replace(wind=winds)))
        return loops, StepInput(speed_cmd, motion.vel_w - air_vel_w)

    def _move(self, flying: np.ndarray, motion: Motion, push: StepInput) -> np.ndarray:
        """Let RotorPy move the bodies; then MuJoCo finds the contacts."""
        qpos, qvel, speed = self._multirotor.step(
            self._qpos, self._qvel, self._loops.plant.rotor_speed, push
        )
        state = np.concatenate([qpos, qvel, speed], axis=-1)
        valid = np.asarray(np.isfinite(state).all(-1))
        moving = flying & valid
        self._qpos[moving], self._qvel[moving] = qpos[moving], qvel[moving]
        speed = np.where(moving[:, None], speed, self._loops.plant.rotor_speed)
        plant = self._loops.plant._replace(rotor_speed=speed)
        self._loops = self._loops._replace(plant=plant)
        self._batch.forward(np.flatnonzero(moving).astype(np.int32), stage=TO_CONTACTS)
        return ~valid


class Multirotor:
    """N independent multirotors of RotorPy with the same vehicle, in double precision."""

    def __init__(self, vehicle: Vehicle, dt: float, count: int) -> None:
        """Make `count` multirotors with the parameters of `vehicle`, for steps of `dt` [s].

        Raises:
            ValueError: where RotorPy is not installed.
        """
        import torch

        module, cpu = rotorpy(), torch.device("cpu")
        parameters = rotorpy_vehicle.rotorpy_parameters(vehicle)
        parameters["tau_m"] = max(parameters["tau_m"], rotorpy_vehicle.shortest_lag_s(vehicle))
        self._dt, self._rows, self._mass = dt, torch.arange(count), parameters["mass"]
        start = {"x": torch.zeros(count, 3, dtype=torch.float64)}
        self._multirotor = module.BatchedMultirotor(
            module.BatchedMultirotorParams([parameters] * count, count, cpu),
            count,
            start,
            cpu,
            integrator="rk4",
        )

    def step(
        self, qpos: np.ndarray, qvel: np.ndarray, rotor_speed: np.ndarray, push: StepInput
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return qpos, qvel and rotor speeds after one step; the object keeps no state.

        Args:
            qpos: (N, 7) position [m] and quaternion wxyz.
            qvel: (N, 6) velocity in the world [m/s] and body rates [rad/s].
            rotor_speed: (N, 4) rotor speeds [rad/s].
            push: inputs that are constant during the step.
        """
        import torch

        state = {
            "x": qpos[:, :3],
            "v": qvel[:, :3],
            "q": qpos[:, 3:][:, XYZW],
            "w": qvel[:, 3:],
            "wind": push.wind_w,
            "rotor_speeds": rotor_speed,
        }
        state = {name: torch.tensor(value) for name, value in state.items()}
        commanded = {"cmd_motor_speeds": torch.tensor(push.rotor_speed)}
        with _in_doubles():
            after = self._multirotor.step(state, commanded, self._dt, self._rows)
        after_arrays = {name: value.numpy() for name, value in after.items()}
        qpos = np.concatenate([after_arrays["x"], after_arrays["q"][:, [3, 0, 1, 2]]], axis=-1)
        return (
            qpos,
            np.concatenate([after_arrays["v"], after_arrays["w"]], axis=-1),
            after_arrays["rotor_speeds"],
        )

    def specific_force_b(
        self, qpos: np.ndarray, qvel: np.ndarray, rotor_speed: np.ndarray
    ) -> np.ndarray:
        """Return the specific force (N, 3) [m/s^2] without wind; arguments as in `step`."""
        import torch

        vel_b = to_local(quat_to_rot(qpos[:, 3:]), qvel[:, :3])
        inputs = (torch.tensor(value) for value in (qvel[:, 3:], rotor_speed, vel_b))
        with _in_doubles():
            force_b, _ = self._multirotor.compute_body_wrench(*inputs, self._rows)
        return force_b.numpy() / self._mass


@contextmanager
def _in_doubles() -> Iterator[None]:
    """Set torch's default type to double, which RotorPy uses for its arrays."""
    import torch

    dtype_before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        with torch.no_grad():
            yield
    finally:
        torch.set_default_dtype(dtype_before)

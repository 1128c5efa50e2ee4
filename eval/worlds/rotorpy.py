"""The simulator `rotorpy`: RotorPy's multirotor flies the trials (Folk, Paulos and Kumar 2023).

Policy, autopilot, rate loop and mixer are the suite's, since a vehicle file describes them; so are
scene, images, contacts and rules. RotorPy's batched multirotor gets the commanded rotor speeds and
simulates the rotors' lag, thrust, drag, air and rigid body. Its integrator is the fixed Runge-Kutta
step of order 4 at the rate loop's frequency. The adaptive one chooses its steps by all rows
together, so a trial would depend on the other trials.
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
from eval.worlds.slots import Layout
from eval.worlds.trial import Rules
from policies.spec import ActionSpec
from tracks.geometry.camera import Camera
from tracks.geometry.rotation import quat_to_rot, to_local

STEPS_A_LAG = 1.0
"""The rotors' time constant is no shorter than so many steps: RotorPy divides by it, and its
integrator follows a shorter one badly."""
XYZW = [1, 2, 3, 0]
"""Index in RotorPy's quaternion of w, x, y and z."""


class Push(NamedTuple):
    """Inputs of a step of RotorPy."""

    rotor_speed: np.ndarray
    """(N, 4) commanded, held during the step [rad/s]."""
    wind_w: np.ndarray
    """(N, 3) held during the step [m/s]."""


class RotorpyWorld(SceneSlots):
    """RotorPy, an optional package: slots of its `BatchedMultirotor`.

    Its logs count as continuous in time.
    """

    name = "rotorpy"
    cost = 6.0

    def __init__(
        self,
        vehicle: Vehicle,
        camera: Camera,
        layout: Layout,
        rules: Rules,
        slots: int,
        threads: int = 1,
        action: ActionSpec | None = None,
    ) -> None:
        """Make the world; the arguments are those of `SceneSlots`.

        Raises:
            ValueError: where RotorPy is not installed.
        """
        super().__init__(vehicle, camera, layout, rules, slots, threads, action)
        self._multirotor = Multirotor(vehicle, self.dt, slots)

    @staticmethod
    def check() -> None:
        """Check that RotorPy is installed and usable.

        Raises:
            ValueError: where it is not installed, with what to do.
        """
        rotorpy()

    @staticmethod
    def differences(vehicle: Vehicle) -> list[str]:
        """Return a sentence for each deviation of the simulation from `vehicle`."""
        return rotorpy_vehicle.differences(vehicle, STEPS_A_LAG / vehicle.controller.frequency)

    @staticmethod
    def nearest(vehicle: Vehicle) -> Vehicle:
        """Return the vehicle file that describes the simulation of `vehicle` best."""
        return rotorpy_vehicle.as_flown(vehicle)

    def _control(
        self,
        motion: Motion,
        action_b: np.ndarray,
        gate_w: np.ndarray,
        step: np.ndarray,
        noise: np.ndarray | None,
    ) -> tuple[AutopilotState, Push]:
        loops = attitude_step(self._autopilot, self._loops, motion, action_b, gate_w, step)
        plant = self._autopilot.plant
        commanded = motor_speed_command(self._autopilot, action_b)
        state, wanted = rotor_command(plant, loops.plant, loops.command, motion.rate_b, commanded)
        winds, air_vel_w = winds_on(plant, state.wind, motion, noise)
        loops = loops._replace(plant=state._replace(wind=winds))
        return loops, Push(wanted, motion.vel_w - air_vel_w)

    def _move(self, flying: np.ndarray, motion: Motion, push: Push) -> np.ndarray:
        qpos, qvel, speed = self._multirotor.step(
            self._qpos, self._qvel, self._loops.plant.rotor_speed, push
        )
        after = np.concatenate([qpos, qvel, speed], axis=-1)
        fits = np.asarray(np.isfinite(after).all(-1))
        go = flying & fits
        self._qpos[go], self._qvel[go] = qpos[go], qvel[go]
        speed = np.where(go[:, None], speed, self._loops.plant.rotor_speed)
        plant = self._loops.plant._replace(rotor_speed=speed)
        self._loops = self._loops._replace(plant=plant)
        self._batch.forward(np.flatnonzero(go).astype(np.int32), stage=TO_CONTACTS)
        return ~fits


class Multirotor:
    """N of RotorPy's multirotors of one vehicle, stepped independently, in double precision."""

    def __init__(self, vehicle: Vehicle, dt: float, count: int) -> None:
        """Make `count` of `vehicle` for steps of `dt` [s].

        Raises:
            ValueError: where RotorPy is not installed.
        """
        import torch

        theirs, cpu = rotorpy(), torch.device("cpu")
        parameters = rotorpy_vehicle.rotorpy_parameters(vehicle, STEPS_A_LAG * dt)
        self._dt, self._rows, self._mass = dt, torch.arange(count), parameters["mass"]
        start = {"x": torch.zeros(count, 3, dtype=torch.float64)}
        self._theirs = theirs.BatchedMultirotor(
            theirs.BatchedMultirotorParams([parameters] * count, count, cpu),
            count,
            start,
            cpu,
            integrator="rk4",
        )

    def step(
        self, qpos: np.ndarray, qvel: np.ndarray, rotor_speed: np.ndarray, push: Push
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return qpos, qvel and rotor speeds after one step; the object has no state.

        Args:
            qpos: (N, 7) position [m] and quaternion wxyz.
            qvel: (N, 6) velocity in the world [m/s] and body rates [rad/s].
            rotor_speed: (N, 4) [rad/s].
            push: what is held during the step.
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
            after = self._theirs.step(state, commanded, self._dt, self._rows)
        part = {name: value.numpy() for name, value in after.items()}
        qpos = np.concatenate([part["x"], part["q"][:, [3, 0, 1, 2]]], axis=-1)
        return qpos, np.concatenate([part["v"], part["w"]], axis=-1), part["rotor_speeds"]

    def specific_force_b(
        self, qpos: np.ndarray, qvel: np.ndarray, rotor_speed: np.ndarray
    ) -> np.ndarray:
        """Return force over mass in still air, (N, 3) [m/s^2]; arguments as in `step`."""
        import torch

        vel_b = to_local(quat_to_rot(qpos[:, 3:]), qvel[:, :3])
        moving = (torch.tensor(part) for part in (qvel[:, 3:], rotor_speed, vel_b))
        with _in_doubles():
            force_b, _ = self._theirs.compute_body_wrench(*moving, self._rows)
        return force_b.numpy() / self._mass


@contextmanager
def _in_doubles() -> Iterator[None]:
    """Set torch's default type to double, which RotorPy uses for its arrays."""
    import torch

    usual = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        with torch.no_grad():
            yield
    finally:
        torch.set_default_dtype(usual)


def rotorpy() -> Any:
    """Return RotorPy's module of multirotors.

    Raises:
        ValueError: where it or its batched part is not installed.
    """
    try:
        for needed in ("torchdiffeq", "roma"):  # which it can do without, but not batched
            importlib.import_module(needed)
        return importlib.import_module("rotorpy.vehicles.multirotor")
    except ModuleNotFoundError as error:
        raise ValueError(
            f"world 'rotorpy' needs the package {error.name!r}: "
            "pip install 'diffracing-suite[rotorpy]'"
        ) from error

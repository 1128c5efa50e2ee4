"""Registry of the simulators ("worlds"), and the interface that each of them has.

A `World` is a simulator: it simulates trials, which are flights along a track, in a fixed number of
slots (places for one trial at a time). It does not depend on policies: it gets actions and returns
views (what a policy can observe). The judge, which scores policies, connects both. Modules of
worlds are imported on first use.

Another package adds a world with an entry point of the group `diffracing_suite.worlds`. A program
adds one for its own process with `WORLDS.register(name, a_class)`.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from eval.quadrotor.plant import Command
from eval.vehicles.vehicle import Vehicle
from eval.worlds.trial import Progress, TrialSpec
from policies.observation import View
from policies.spec import ActionSpec
from tracks.common.names import Registry
from tracks.track import Track


def _registration_error(name: str, world: Any) -> str | None:
    """Return why `world` cannot be registered, or None."""
    methods = ("load", "view", "advance", "collided_with")
    if callable(world) and all(hasattr(world, method) for method in methods):
        return None
    return f"{world!r}; must be a class with the methods {', '.join(methods)} (`World`)"


WORLDS: Registry[Any] = Registry(
    "simulator",
    "diffracing_suite.worlds",
    {
        "mujoco": "eval.worlds.mujoco:MujocoWorld",
        "mjx": "eval.worlds.mjx:MjxWorld",
        "rotorpy": "eval.worlds.rotorpy:RotorpyWorld",
    },
    _registration_error,
)
"""Name of a simulator -> class (a `World`), called with (vehicle, camera, layout, rules, slots=,
threads=)."""


class Rows(NamedTuple):
    """States of all N slots at one physics step, for the rows of the trials' flight logs."""

    due: np.ndarray
    """(N,) bool, the slots whose flight log gets a row at this step."""
    time_s: np.ndarray
    """(N,) time since each trial's start [s]."""
    pos_w: np.ndarray
    """(N, 3) position of the centre of mass [m]."""
    quat_wxyz: np.ndarray
    """(N, 4) attitude, body to world."""
    vel_w: np.ndarray
    """(N, 3) velocity [m/s]."""
    rate_b: np.ndarray
    """(N, 3) body rates [rad/s]."""
    thrust_cmd: np.ndarray
    """(N,) commanded thrust per nominal mass [m/s^2]."""
    rate_cmd_b: np.ndarray
    """(N, 3) commanded body rates [rad/s]."""
    rotor_speed: np.ndarray
    """(N, 4) rotor speeds [rad/s]."""
    gate: np.ndarray
    """(N,) number of the next gate."""


def rows_of(
    due: Any,
    progress: Progress,
    dt: float,
    qpos: Any,
    qvel: Any,
    command: Command,
    rotor_speed: Any,
) -> Rows:
    """Return the rows of free joints `qpos` (N, 7) and `qvel` (N, 6); numpy and JAX arrays."""
    return Rows(
        due, progress.step * dt, qpos[:, :3], qpos[:, 3:], qvel[:, :3], qvel[:, 3:],
        command.thrust, command.rate_b, rotor_speed, progress.gates,
    )  # fmt: skip


class World(Protocol):
    """A simulator with a fixed number of slots, in each of which one trial flies at a time.

    Optional attributes:

    - `integrator` (`"euler"`) is written to flight logs, with the length of a step. A log without
      it counts as continuous in time: a diagnosis assumes that its integrator has no error.
    - `cost` is the computing time of a trial relative to MuJoCo's, for estimates; default 1.
    - `compiles` is true where each number of slots needs a compilation. Such a world has the same
      number of slots for any number of trials, and gets all trials at once, in one process.
    - `actions` are the supported kinds of action other than acceleration. The class then takes an
      argument `action`, a `policies.spec.ActionSpec`.

    Optional static methods:

    - `check()` raises a ValueError for a missing package.
    - `differences(vehicle)` returns a sentence for each deviation from the vehicle file.
    - `nearest(vehicle)` returns the vehicle file that describes the simulated vehicle best.
    """

    slots: int
    """Number of trials that fly at the same time."""
    dt: float
    """Length of a physics step [s]."""

    @property
    def progress(self) -> Progress:
        """Progress of the trial in each slot, numpy arrays (N, ...)."""
        ...

    def load(self, entries: list[tuple[int, Track, TrialSpec]]) -> None:
        """Start the trials `entries`, each (slot, track, trial).

        A trial whose drone is in contact at time 0 has ended already.
        """
        ...

    def view(self, wanted: np.ndarray) -> View:
        """Return the current view; images only for the slots in `wanted` (N,) bool."""
        ...

    def advance(self, action_b: np.ndarray, steps: np.ndarray, record: bool) -> list[Rows]:
        """Fly each slot's action (N, size) for its number of physics steps (N,).

        A trial that ends keeps its last state.

        Returns:
            With `record`, the rows of the flight logs: before every new command, and at the end of
            a trial; else [].
        """
        ...

    def collided_with(self, slot: int) -> str:
        """Return the name of the solid that the trial in `slot` collided with."""
        ...


def world_class(name: str) -> Any:
    """Return the class of the world `name`.

    Raises:
        ValueError: for an unknown simulator, or a missing package.
    """
    world = WORLDS.find(name)
    if hasattr(world, "check"):
        world.check()
    return world


def action_argument(name: str, action: ActionSpec) -> dict[str, ActionSpec]:
    """Return the argument `action` of the world's class; {} for an acceleration, the default.

    Raises:
        ValueError: where the simulator does not support this kind of action.
    """
    if action.kind == "acceleration":
        return {}
    if action.kind not in getattr(WORLDS.find(name), "actions", ()):
        raise ValueError(
            f"simulator {name!r} supports no actions of kind {action.kind!r}; fly in 'mujoco', or "
            "give its class `actions` and the argument `action` (docs/extend.md)"
        )
    return {"action": action}


def compiles(name: str) -> bool:
    """Return whether the world `name` needs a compilation for each number of slots."""
    return getattr(WORLDS.find(name), "compiles", False)


def differences(name: str, vehicle: Vehicle) -> list[str]:
    """Return a sentence for each deviation of the simulator `name` from `vehicle`.

    Raises:
        ValueError: for an unknown simulator, or a missing package.
    """
    world = world_class(name)
    return world.differences(vehicle) if hasattr(world, "differences") else []


def nearest(name: str, vehicle: Vehicle) -> Vehicle:
    """Return the vehicle file that describes `vehicle` in the simulator `name` best.

    It is `vehicle` itself, unless the simulator has other aerodynamics.

    Raises:
        ValueError: for an unknown simulator, or a missing package.
    """
    world = world_class(name)
    return world.nearest(vehicle) if hasattr(world, "nearest") else vehicle

"""Simulators ("worlds") by name; their modules are imported on first use.

Another package adds one with an entry point of the group `diffracing_suite.worlds`, a program for
its own process with `WORLDS.register(name, a_class)`.

A world simulates trials in a fixed number of slots. It is independent of policies: it gets actions
and returns views.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from eval.vehicles.vehicle import Vehicle
from eval.worlds.trial import Progress, TrialSpec
from policies.observation import View
from policies.spec import ActionSpec
from tracks.common.names import Registry
from tracks.track import Track

REFERENCE = "reference"
"""The simulator without slots: `eval.worlds.reference.fly_trial`, one trial at a time."""
WORLDS: Registry[Any] = Registry(
    "simulator",
    "diffracing_suite.worlds",
    {
        "mujoco": "eval.worlds.mujoco:MujocoWorld",
        "mjx": "eval.worlds.mjx:MjxWorld",
        REFERENCE: "eval.worlds.reference:fly_trial",
        "rotorpy": "eval.worlds.rotorpy:RotorpyWorld",
    },
    lambda name, world: None if callable(world) else f"{world!r}; must be a class (`World`)",
)
"""Name to class (`World`), called with (vehicle, camera, layout, rules, slots=, threads=)."""


class Rows(NamedTuple):
    """States to record at one physics step: rows of a flight log, for the slots in `due`."""

    due: np.ndarray
    """(N,) bool."""
    time_s: np.ndarray
    """(N,) since each trial's start [s]."""
    pos_w: np.ndarray
    """(N, 3) centre of mass [m]."""
    quat_wxyz: np.ndarray
    """(N, 4) body to world."""
    vel_w: np.ndarray
    """(N, 3) [m/s]."""
    rate_b: np.ndarray
    """(N, 3) [rad/s]."""
    thrust_cmd: np.ndarray
    """(N,) per nominal mass [m/s^2]."""
    rate_cmd_b: np.ndarray
    """(N, 3) [rad/s]."""
    rotor_speed: np.ndarray
    """(N, 4) [rad/s]."""
    gate: np.ndarray
    """(N,) number of the next gate."""


class World(Protocol):
    """A fixed number of slots, each flying one trial at a time.

    Optional attributes: `integrator` (`"euler"`) goes into its logs, with the step; logs without it
    count as continuous in time. `cost` is the time of a trial relative to MuJoCo, for estimates; 1
    without it. `compiles` is true where each number of slots compiles a program of its own: such a
    world gets all trials at once, in one process. `actions` are the kinds of action besides
    acceleration; the class then takes an argument `action`, a `policies.spec.ActionSpec`.

    Optional static methods: `check()` raises a ValueError for a missing package;
    `differences(vehicle)` returns a sentence for each deviation from the vehicle file;
    `nearest(vehicle)` returns the vehicle that describes the simulated one best.
    """

    name: str
    slots: int
    dt: float
    """Length of a physics step [s]."""

    @property
    def progress(self) -> Progress:
        """Progress of the trial in each slot, numpy arrays (N, ...)."""
        ...

    def load(self, entries: list[tuple[int, Track, TrialSpec]]) -> None:
        """Start trials from (slot, track, trial); their states at time 0 are judged."""
        ...

    def view(self, wanted: np.ndarray) -> View:
        """Return the current view; images only for the slots in `wanted` (N,) bool."""
        ...

    def advance(self, action_b: np.ndarray, steps: np.ndarray, record: bool) -> list[Rows]:
        """Fly each slot's action (N, size) for its number of physics steps (N,).

        A trial that ends stays where it ended. With `record` the rows come back: before every
        new command, and the state in which a trial ended.
        """
        ...

    def collided_with(self, slot: int) -> str:
        """Return the name of the solid that the trial in `slot` collided with."""
        ...


def world_class(name: str) -> Any:
    """Return the class of the world `name` (for `REFERENCE` the function).

    Raises:
        ValueError: for an unknown simulator, or a missing package.
    """
    world = WORLDS.find(name)
    if hasattr(world, "check"):
        world.check()
    return world


def flown_by(name: str, action: ActionSpec) -> dict[str, ActionSpec]:
    """Return the argument for another kind of action than acceleration; {} for acceleration.

    Raises:
        ValueError: where that simulator supports accelerations only.
    """
    if action.kind == "acceleration":
        return {}
    if action.kind not in getattr(WORLDS.find(name), "actions", ()):
        raise ValueError(
            f"simulator {name!r} flies no actions of kind {action.kind!r}; fly in 'mujoco', or "
            "give its class `actions` and the argument `action` (docs/worlds.md)"
        )
    return {"action": action}


def compiles(name: str) -> bool:
    """Return whether the world `name` compiles a program for its number of slots."""
    return getattr(WORLDS.find(name), "compiles", False)


def differences(name: str, vehicle: Vehicle) -> list[str]:
    """Return a sentence for each deviation of the simulator `name` from `vehicle`.

    Raises:
        ValueError: for an unknown simulator, or a missing package.
    """
    world = world_class(name)
    return world.differences(vehicle) if hasattr(world, "differences") else []

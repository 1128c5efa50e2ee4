"""Worlds: where trials are flown. The table of names; modules are imported when asked for.

Another package adds one with an entry point of the group `diffracing_suite.worlds`, a program for
its own process with `WORLDS.register(name, a_class)`.

A world flies the trials in a fixed number of slots and knows nothing of policies: it is given
actions and hands back what a policy needs to see.
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
"""The world without slots: `eval.worlds.reference.fly_trial`, one trial after the other."""
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

    A world whose step shows in its flights has an attribute `integrator` (`"euler"`), which its
    logs then carry together with the step; without it they count as continuous in time.

    Static methods that it may have: `check()` raises a ValueError with what to do where a package
    is missing; `differences(vehicle)` returns a sentence for everything that it flies otherwise
    than the file says; `nearest(vehicle)` the vehicle whose file says best what it flies. `cost` is
    what a trial costs over one in MuJoCo, for estimates; 1 without it. `compiles` is true where
    every number of slots is a program of its own: such a world is given all trials at once, in one
    process and in as many slots as are asked for. `actions` are the kinds that it flies besides
    acceleration; it then takes an argument `action`, a `policies.spec.ActionSpec`.
    """

    name: str
    slots: int
    dt: float
    """Length of a physics step [s]."""

    @property
    def progress(self) -> Progress:
        """Where the trial in each slot stands, numpy arrays (N, ...)."""
        ...

    def load(self, entries: list[tuple[int, Track, TrialSpec]]) -> None:
        """Start trials from (slot, track, trial); their states at time 0 are judged."""
        ...

    def view(self, wanted: np.ndarray) -> View:
        """Return what can be observed now; images only of the slots in `wanted` (N,) bool."""
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
        ValueError: where there is no such world, or it lacks a package.
    """
    world = WORLDS.find(name)
    if hasattr(world, "check"):
        world.check()
    return world


def flown_by(name: str, action: ActionSpec) -> dict[str, ActionSpec]:
    """Return the argument that makes the world `name` fly another kind of action, if it is one.

    Raises:
        ValueError: where that world flies accelerations alone.
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
    """Return a sentence for everything of `vehicle` that the world `name` flies otherwise.

    Raises:
        ValueError: where there is no such world, or it lacks a package.
    """
    world = world_class(name)
    return world.differences(vehicle) if hasattr(world, "differences") else []

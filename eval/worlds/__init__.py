"""Worlds: where trials are flown. The table of names; modules are imported when asked for.

A world flies the trials in a fixed number of slots and knows nothing of policies: it is given
actions and hands back what a policy needs to see.
"""

from __future__ import annotations

import importlib
from typing import Any, NamedTuple, Protocol

import numpy as np

from eval.worlds.trial import Progress, TrialSpec
from tracks.common.names import unknown_name
from tracks.track import Track

REFERENCE = "reference"
"""The world without slots: `eval.worlds.reference.fly_trial`, one trial after the other."""
WORLDS = {
    "mujoco": "eval.worlds.mujoco:MujocoWorld",
    "mjx": "eval.worlds.mjx:MjxWorld",
    REFERENCE: "eval.worlds.reference:fly_trial",
}
"""Name to module and class (`World`)."""


class View(NamedTuple):
    """What can be observed in each slot, (N, ...); rows of empty slots hold anything finite."""

    pos_w: np.ndarray
    """(N, 3) [m]."""
    rot_w: np.ndarray
    """(N, 3, 3) body to world."""
    vel_w: np.ndarray
    """(N, 3) [m/s]."""
    gate_w: np.ndarray
    """(N, 3) centre of the next gate [m]."""
    second_w: np.ndarray
    """(N, 3) centre of the gate after it, or of the last gate where there is none [m]."""
    axis_w: np.ndarray
    """(N, 3) unit vector along which the next gate is flown through."""
    depth_m: np.ndarray
    """(N, H, W) planar depth, clipped to the camera's range [m]."""


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
    """A fixed number of slots, each flying one trial at a time."""

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
        """Fly each slot's action (N, 3) for its number of physics steps (N,).

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
        ValueError: where there is no such world.
    """
    if name not in WORLDS:
        raise unknown_name("world", name, WORLDS)
    module, attribute = WORLDS[name].split(":")
    return getattr(importlib.import_module(module), attribute)

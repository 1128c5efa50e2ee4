"""Physics that no effect of the catalogue describes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from eval.effects.interface import GRAVITY
from eval.quadrotor.plant import Command, Motion, Wrench
from tracks.common.names import unknown_name
from tracks.geometry.rotation import to_local

Law = Callable[[float, float, Motion, Wrench, float], np.ndarray]


class Outside:
    """Nothing; a kind changes the command or adds a wrench. One object serves one `fly`."""

    def __init__(self, strength: float, mass: float) -> None:
        """Prepare for flights of a quadrotor of true `mass` [kg]; `strength` as in `KINDS`."""
        self.strength, self.mass = strength, mass

    def command(self, command: Command, time_s: float) -> Command:
        """Return the command that acts."""
        return command

    def wrench(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> Wrench:
        """Return what is added to `wrench`."""
        acc_w = self.acc_w(motion, wrench, time_s, dt)
        force_b = self.mass * to_local(motion.rot_w, acc_w)
        return Wrench(force_b, np.zeros_like(force_b))

    def acc_w(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> np.ndarray:
        """Return an acceleration (N, 3) in the world that is added [m/s^2]."""
        return np.zeros_like(motion.pos_w)


class SlungLoad(Outside):
    """A point mass of `strength` kg on an elastic line below the centre of mass.

    An engine's own law: the catalogue's load is on a stiff line, and no diagnosis fits that.
    """

    LENGTH_M, STIFFNESS, DAMPING = 0.4, 60.0, 0.3

    def __init__(self, strength: float, mass: float) -> None:
        """Prepare; the load hangs at rest when the flight starts."""
        super().__init__(strength, mass)
        self._pos_w = self._vel_w = np.zeros(0)

    def acc_w(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> np.ndarray:
        """Return the line's pull, and move the load."""
        if not self._pos_w.size:
            stretch = self.strength * GRAVITY / self.STIFFNESS
            self._pos_w = motion.pos_w - np.array([0.0, 0.0, self.LENGTH_M + stretch])
            self._vel_w = motion.vel_w.copy()
        line = self._pos_w - motion.pos_w
        length = np.sqrt((line**2).sum(-1, keepdims=True))
        along = line / length
        closing = ((self._vel_w - motion.vel_w) * along).sum(-1, keepdims=True)
        tension = self.STIFFNESS * (length - self.LENGTH_M) + self.DAMPING * closing
        pull = np.where(length > self.LENGTH_M, np.maximum(tension, 0.0), 0.0) * along
        self._vel_w = self._vel_w + dt * (-pull / self.strength + [0.0, 0.0, -GRAVITY])
        self._pos_w = self._pos_w + dt * self._vel_w
        return pull / self.mass


class Hysteresis(Outside):
    """Backlash of `strength` m/s^2 in the collective thrust."""

    def __init__(self, strength: float, mass: float) -> None:
        """Prepare; the play starts in its middle."""
        super().__init__(strength, mass)
        self._acting = np.zeros(0)

    def command(self, command: Command, time_s: float) -> Command:
        """Return the thrust that follows only when it is pushed by the play's edges."""
        half = 0.5 * self.strength
        before = self._acting if self._acting.size else command.thrust
        self._acting = np.clip(before, command.thrust - half, command.thrust + half)
        return Command(np.maximum(self._acting, 0.0), command.rate_b)


class BentThrust(Outside):
    """A thrust curve that is bent and not only scaled."""

    def command(self, command: Command, time_s: float) -> Command:
        """Return c + s (c - g)^2 / g."""
        thrust = command.thrust
        bent = thrust + self.strength * (thrust - GRAVITY) ** 2 / GRAVITY
        return Command(np.maximum(bent, 0.0), command.rate_b)


class Push(Outside):
    """An acceleration in the world that follows from the state alone."""

    def __init__(self, strength: float, mass: float, law: Law) -> None:
        """Prepare; `law` takes (strength, mass, motion, wrench, time) and returns (N, 3)."""
        super().__init__(strength, mass)
        self._law = law

    def acc_w(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> np.ndarray:
        """Return what the law says."""
        return self._law(self.strength, self.mass, motion, wrench, time_s)


def _power_drag(s: float, m: float, motion: Motion, wrench: Wrench, t: float) -> np.ndarray:
    """Drag with |v|^1.6: -s |v|^0.6 v."""
    speed = np.sqrt((motion.vel_w**2).sum(-1, keepdims=True))
    return -s * speed**0.6 * motion.vel_w


def _heading_force(s: float, m: float, motion: Motion, wrench: Wrench, t: float) -> np.ndarray:
    """A sideways push that changes its sign twice a turn: s cos(2 yaw) along body y."""
    yaw = np.arctan2(motion.rot_w[:, 1, 0], motion.rot_w[:, 0, 0])
    return s * np.cos(2.0 * yaw)[:, None] * motion.rot_w[:, :, 1]


def _wake(s: float, m: float, motion: Motion, wrench: Wrench, t: float) -> np.ndarray:
    """Sinking into the own wake: -s (sinking speed beyond 0.5 m/s)^2 along body z."""
    sinking = np.maximum(-motion.vel_w[:, 2:] - 0.5, 0.0)
    return -s * sinking**2 * motion.rot_w[:, :, 2]


def _tether(s: float, m: float, motion: Motion, wrench: Wrench, t: float) -> np.ndarray:
    """A spring to a place in the world: -s (pos - anchor)."""
    return -s * (motion.pos_w - np.array([1.0, -1.0, 0.0]))


def _ripple(s: float, m: float, motion: Motion, wrench: Wrench, t: float) -> np.ndarray:
    """Thrust that pulses at 3.1 Hz: s sin(2 pi 3.1 t) of it."""
    share = s * np.sin(2.0 * np.pi * 3.1 * t)
    return share * wrench.force_b[:, 2:] / m * motion.rot_w[:, :, 2]


def _updraft(s: float, m: float, motion: Motion, wrench: Wrench, t: float) -> np.ndarray:
    """A column of rising air: s exp(-r^2 / 2 (0.9 m)^2) upwards, r from the column's middle."""
    square = ((motion.pos_w[:, :2] - np.array([2.0, 1.0])) ** 2).sum(-1)
    return (s * np.exp(-0.5 * square / 0.9**2))[:, None] * np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Kind:
    """One kind of physics outside the catalogue."""

    make: Callable[..., Outside]
    """From strength and true mass [kg]."""
    unit: str
    """Of the strength."""
    usual: float
    """A strength at which the table of strengths looks at it."""
    most: float
    """The largest strength that is flown."""


KINDS: dict[str, Kind] = {
    "power_drag": Kind(partial(Push, law=_power_drag), "m^-0.6 s^-0.4", 0.08, 0.4),
    "slung_load": Kind(SlungLoad, "kg", 0.03, 0.12),
    "hysteresis": Kind(Hysteresis, "m/s^2", 1.0, 3.0),
    "heading_force": Kind(partial(Push, law=_heading_force), "m/s^2", 0.5, 2.5),
    "wake": Kind(partial(Push, law=_wake), "1/m", 0.3, 1.2),
    "tether": Kind(partial(Push, law=_tether), "1/s^2", 0.1, 0.6),
    "ripple": Kind(partial(Push, law=_ripple), "1", 0.05, 0.3),
    "updraft": Kind(partial(Push, law=_updraft), "m/s^2", 1.0, 5.0),
    "bent_thrust": Kind(BentThrust, "1", 0.1, 0.4),
}
"""Kinds by name."""


def make_outside(name: str, strength: float, mass: float) -> Outside:
    """Return the physics `name` at `strength` for a quadrotor of true `mass` [kg].

    Raises:
        ValueError: for an unknown name.
    """
    if name not in KINDS:
        raise unknown_name("physics outside the catalogue", name, KINDS)
    return KINDS[name].make(strength, mass)

"""Physics that no effect of the catalogue describes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from eval.effects.interface import GRAVITY
from eval.quadrotor.plant import Command, Motion, Wrench
from tracks.common.names import unknown_name
from tracks.geometry.rotation import to_local


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


class PowerDrag(Outside):
    """Drag with |v|^1.6."""

    def acc_w(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> np.ndarray:
        """Return -s |v|^0.6 v."""
        speed = np.sqrt((motion.vel_w**2).sum(-1, keepdims=True))
        return -self.strength * speed**0.6 * motion.vel_w


class SlungLoad(Outside):
    """A point mass of `strength` kg on an elastic line below the centre of mass."""

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


class HeadingForce(Outside):
    """A sideways push that changes its sign twice a turn of the heading."""

    def acc_w(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> np.ndarray:
        """Return s cos(2 yaw) along body y."""
        yaw = np.arctan2(motion.rot_w[:, 1, 0], motion.rot_w[:, 0, 0])
        return self.strength * np.cos(2.0 * yaw)[:, None] * motion.rot_w[:, :, 1]


class Wake(Outside):
    """Thrust lost while sinking into the own wake."""

    def acc_w(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> np.ndarray:
        """Return -s (sinking speed beyond 0.5 m/s)^2 along body z."""
        sinking = np.maximum(-motion.vel_w[:, 2:] - 0.5, 0.0)
        return -self.strength * sinking**2 * motion.rot_w[:, :, 2]


class Tether(Outside):
    """A spring to a place in the world."""

    ANCHOR_W = np.array([1.0, -1.0, 0.0])

    def acc_w(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> np.ndarray:
        """Return -s (pos - anchor)."""
        return -self.strength * (motion.pos_w - self.ANCHOR_W)


class Ripple(Outside):
    """Thrust that pulses at 3.1 Hz."""

    def acc_w(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> np.ndarray:
        """Return s sin(2 pi 3.1 t) of the thrust."""
        share = self.strength * np.sin(2.0 * np.pi * 3.1 * time_s)
        return share * wrench.force_b[:, 2:] / self.mass * motion.rot_w[:, :, 2]


class Updraft(Outside):
    """A column of rising air at one place."""

    CENTER_W = np.array([2.0, 1.0])

    def acc_w(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> np.ndarray:
        """Return s exp(-r^2 / 2 (0.9 m)^2) upwards, r from the column's middle."""
        square = ((motion.pos_w[:, :2] - self.CENTER_W) ** 2).sum(-1)
        push = self.strength * np.exp(-0.5 * square / 0.9**2)
        return push[:, None] * np.array([0.0, 0.0, 1.0])


class BentThrust(Outside):
    """A thrust curve that is bent and not only scaled."""

    def command(self, command: Command, time_s: float) -> Command:
        """Return c + s (c - g)^2 / g."""
        thrust = command.thrust
        bent = thrust + self.strength * (thrust - GRAVITY) ** 2 / GRAVITY
        return Command(np.maximum(bent, 0.0), command.rate_b)


@dataclass(frozen=True)
class Kind:
    """One kind of physics outside the catalogue."""

    make: Callable[[float, float], Outside]
    """From strength and true mass [kg]."""
    unit: str
    """Of the strength."""
    usual: float
    """A strength at which the table of strengths looks at it."""
    most: float
    """The largest strength that is flown."""


KINDS: dict[str, Kind] = {
    "power_drag": Kind(PowerDrag, "m^-0.6 s^-0.4", 0.08, 0.4),
    "slung_load": Kind(SlungLoad, "kg", 0.03, 0.12),
    "hysteresis": Kind(Hysteresis, "m/s^2", 1.0, 3.0),
    "heading_force": Kind(HeadingForce, "m/s^2", 0.5, 2.5),
    "wake": Kind(Wake, "1/m", 0.3, 1.2),
    "tether": Kind(Tether, "1/s^2", 0.1, 0.6),
    "ripple": Kind(Ripple, "1", 0.05, 0.3),
    "updraft": Kind(Updraft, "m/s^2", 1.0, 5.0),
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

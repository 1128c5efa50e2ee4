"""Commanded trajectories: position, velocity, acceleration and heading as functions of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from tracks.common.names import unknown_name

EASE_S = 0.7
"""Time constant with which a trajectory reaches its speed from rest [s]."""
STEP_S = 1e-3
"""Step of the central differences for velocity and acceleration [s]."""
EIGHT_FACTOR = 1.0 / np.sqrt(2.0)
"""Angular frequency times size of a figure eight, divided by its largest speed."""
CYCLE_S = 6.0
"""Period of the changing speed of `speed_range` [s]."""
PUNCH_M, PUNCH_HZ = 0.18, 1.1
"""Amplitude [m] and frequency [Hz] of the vertical oscillation of `punches`, which changes the
thrust by about its mean."""
WOBBLE = 1.7
"""Angular frequency of the heading's oscillation [rad/s]."""


class Reference(NamedTuple):
    """Set points at T times."""

    pos_w: np.ndarray
    """(T, 3) position [m]."""
    vel_w: np.ndarray
    """(T, 3) velocity [m/s]."""
    acc_w: np.ndarray
    """(T, 3) acceleration [m/s^2]."""
    yaw: np.ndarray
    """(T,) heading of body x about world z [rad]."""


@dataclass(frozen=True)
class Trajectory:
    """A commanded flight, which these parameters determine completely."""

    kind: str
    """Kind of path, one of `KINDS`."""
    duration_s: float = 10.0
    """Duration of the flight [s]."""
    speed: float = 4.0
    """Approximate largest speed [m/s]."""
    size: float = 3.0
    """Radius, or half of the largest extent [m]."""
    height: float = 1.5
    """Mean height above z = 0 [m]."""
    direction: float = 0.0
    """Rotation of the path about z [rad]."""
    turn: str = "fixed"
    """Change of the heading: fixed, sweep (a constant rate), or wobble (an oscillation)."""
    yaw_rate: float = 1.0
    """Rate of a sweep, or the largest rate of a wobble [rad/s]."""

    def reference(self, time_s: np.ndarray) -> Reference:
        """Return the set points at `time_s` (T,) >= 0 [s].

        Raises:
            ValueError: for an unknown kind or turn.
        """
        if self.kind not in KINDS:
            raise unknown_name("trajectory", self.kind, KINDS)
        if self.turn not in _TURNS:
            raise unknown_name("turn", self.turn, _TURNS)
        time_s = np.asarray(time_s, dtype=float)
        now, before, after = (self._position(time_s + d) for d in (0.0, -STEP_S, STEP_S))
        vel_w = (after - before) / (2.0 * STEP_S)
        acc_w = (after - 2.0 * now + before) / STEP_S**2
        return Reference(now, vel_w, acc_w, self.direction + _TURNS[self.turn](self, time_s))

    def _position(self, time_s: np.ndarray) -> np.ndarray:
        """Return positions (T, 3) [m] along the path.

        The path is a function of an eased time, which begins with a rate of 0, so that the flight
        starts at rest.
        """
        time_s = np.maximum(time_s, 0.0)
        eased_s = time_s - EASE_S * -np.expm1(-time_s / EASE_S)
        x, y, z = np.broadcast_arrays(*KINDS[self.kind](self, eased_s))
        cos, sin = np.cos(self.direction), np.sin(self.direction)
        return np.stack([cos * x - sin * y, sin * x + cos * y, self.height + z], axis=-1)


Path = Callable[[Trajectory, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]
"""A function of a trajectory and its eased time u (T,) [s] that returns x, y and z, (T,) [m]."""


def _figure_eight(path: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    phase = path.speed * EIGHT_FACTOR / path.size * u
    return path.size * np.sin(phase), 0.5 * path.size * np.sin(2.0 * phase), 0.2 * np.sin(phase)


def _circle(path: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    phase = path.speed / path.size * u
    return path.size * np.cos(phase), path.size * np.sin(phase), 0.0 * u


def _speed_range(path: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    # On a circle; the speed oscillates between a fifth of the largest and the largest.
    omega = 2.0 * np.pi / CYCLE_S
    length_m = path.speed * (0.6 * u + 0.4 / omega * (1.0 - np.cos(omega * u)))
    phase = length_m / path.size
    return path.size * np.cos(phase), path.size * np.sin(phase), 0.0 * u


def _climb(path: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    phase = path.speed / path.size * u
    return 0.7 * path.size * np.sin(0.5 * phase), 0.0 * u, path.size * (1.0 - np.cos(phase))


def _punches(path: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    phase, beat = path.speed / path.size * u, 2.0 * np.pi * PUNCH_HZ * u
    return path.size * np.cos(phase), path.size * np.sin(phase), PUNCH_M * np.sin(beat)


def _chirp(path: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return oscillations along all axes, whose frequencies grow during the flight."""

    def sweep(first_hz: float, last_hz: float) -> np.ndarray:
        """Return an oscillation whose frequency grows linearly, with about constant speed."""
        slope = (last_hz - first_hz) / path.duration_s
        omega = 2.0 * np.pi * (first_hz + slope * u)
        return 0.5 * path.speed / omega * np.sin(2.0 * np.pi * (first_hz + 0.5 * slope * u) * u)

    return sweep(0.3, 1.4), sweep(0.4, 1.6), 0.5 * sweep(0.5, 2.2)


def _low(path: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    phase = path.speed / path.size * u
    return path.size * np.sin(phase), 0.0 * u, 0.4 * path.height * np.sin(1.3 * u)


KINDS: dict[str, Path] = {
    "hover": lambda path, u: (0.0 * u, 0.0 * u, 0.0 * u),
    "figure_eight": _figure_eight,
    "circle": _circle,
    "speed_range": _speed_range,
    "climb": _climb,
    "vertical": lambda path, u: (
        0.0 * u,
        0.0 * u,
        path.size * (1.0 - np.cos(path.speed / path.size * u)),
    ),  # fmt: skip
    "punches": _punches,
    "chirp": _chirp,
    "low": _low,
}
"""Kind -> path around the origin, before rotation and height are added."""

_TURNS: dict[str, Callable[[Trajectory, np.ndarray], np.ndarray]] = {
    "fixed": lambda path, t: 0.0 * t,
    "sweep": lambda path, t: path.yaw_rate * t,
    "wobble": lambda path, t: path.yaw_rate / WOBBLE * (1.0 - np.cos(WOBBLE * t)),
}
"""Name of a turn -> heading (T,) [rad] at times t (T,) [s]."""


def ordinary_flights(rng: np.random.Generator, duration_s: float = 10.0) -> list[Trajectory]:
    """Return five random flights that together excite all dynamics.

    They are a figure eight, a range of speeds, a climb, a chirp and a flight near the ground.
    """

    def random_flight(kind: str, **ranges: tuple[float, float]) -> Trajectory:
        values: dict[str, Any] = {
            key: float(rng.uniform(*limits)) for key, limits in ranges.items()
        }
        direction = float(rng.uniform(0.0, 2.0 * np.pi))
        return replace(Trajectory(kind, duration_s), direction=direction, **values)

    return [
        replace(random_flight("figure_eight", speed=(4, 7), size=(3, 5)), turn="wobble"),
        replace(
            random_flight("speed_range", speed=(6, 9), size=(5, 8), height=(1, 3)), turn="sweep"
        ),
        random_flight("climb", speed=(2, 4), size=(1.5, 3)),
        replace(random_flight("chirp", speed=(1.0, 1.6)), turn="wobble"),
        random_flight("low", speed=(0.8, 1.5), size=(1, 2), height=(0.1, 0.16)),
    ]


def long_flights(rng: np.random.Generator) -> list[Trajectory]:
    """Return three random flights of a minute, for effects that change slowly."""
    return [
        Trajectory(
            "figure_eight",
            duration_s=60.0,
            speed=float(rng.uniform(3, 6)),
            size=float(rng.uniform(3, 5)),
            direction=float(rng.uniform(0.0, 2.0 * np.pi)),
            turn="wobble",
        )
        for _ in range(3)
    ]

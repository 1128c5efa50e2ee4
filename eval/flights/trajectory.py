"""Commanded trajectories: place, velocity and heading as functions of time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tracks.common.names import unknown_name

EASE_S = 0.7
"""A trajectory starts at rest and reaches its speed with this time constant [s]."""
STEP_S = 1e-3
"""Of the central differences that make velocity and acceleration from position [s]."""
TIPS = 1.0 / np.sqrt(2.0)
"""Of a figure eight: its angular frequency times its size over its largest speed."""


class Reference(NamedTuple):
    """Where to be at T times."""

    pos_w: np.ndarray
    """(T, 3) [m]."""
    vel_w: np.ndarray
    """(T, 3) [m/s]."""
    acc_w: np.ndarray
    """(T, 3) [m/s^2]."""
    yaw: np.ndarray
    """(T,) of body x about world z [rad]."""


@dataclass(frozen=True)
class Trajectory:
    """A commanded flight, reproducible from these numbers alone."""

    kind: str
    """One of `KINDS`."""
    duration_s: float = 10.0
    """Of the flight."""
    speed: float = 4.0
    """Largest speed that the kind aims at [m/s]."""
    size: float = 3.0
    """Radius or half of the longest stretch [m]."""
    height: float = 1.5
    """Mean height above z = 0 [m]."""
    direction: float = 0.0
    """By which the whole path is turned about z [rad]."""
    turn: str = "fixed"
    """What the heading does: fixed, sweep (turns on and on), or wobble (to and fro)."""
    yaw_rate: float = 1.0
    """Of a sweep; the largest of a wobble [rad/s]."""

    def reference(self, time_s: np.ndarray) -> Reference:
        """Return where to be at `time_s` (T,) >= 0 [s].

        Raises:
            ValueError: for a kind or a turn that is not known.
        """
        if self.kind not in KINDS:
            raise unknown_name("trajectory", self.kind, KINDS)
        if self.turn not in _TURNS:
            raise unknown_name("turn", self.turn, _TURNS)
        time_s = np.asarray(time_s, dtype=float)
        now, before, after = (self._place(time_s + d) for d in (0.0, -STEP_S, STEP_S))
        vel_w = (after - before) / (2.0 * STEP_S)
        acc_w = (after - 2.0 * now + before) / STEP_S**2
        return Reference(now, vel_w, acc_w, self.direction + _TURNS[self.turn](self, time_s))

    def _place(self, time_s: np.ndarray) -> np.ndarray:
        late = np.maximum(time_s, 0.0)
        eased = late - EASE_S * -np.expm1(-late / EASE_S)
        x, y, z = np.broadcast_arrays(*KINDS[self.kind](self, eased))
        cos, sin = np.cos(self.direction), np.sin(self.direction)
        return np.stack([cos * x - sin * y, sin * x + cos * y, self.height + z], axis=-1)


Path = Callable[[Trajectory, np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def _hover(way: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return 0.0 * u, 0.0 * u, 0.0 * u


def _figure_eight(way: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    phase = way.speed * TIPS / way.size * u
    return way.size * np.sin(phase), 0.5 * way.size * np.sin(2.0 * phase), 0.2 * np.sin(phase)


def _circle(way: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    phase = way.speed / way.size * u
    return way.size * np.cos(phase), way.size * np.sin(phase), 0.0 * u


def _speed_range(way: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    # The speed runs between a fifth of the largest and the largest, once in six seconds.
    pace = 2.0 * np.pi / 6.0
    way_m = way.speed * (0.6 * u + 0.4 / pace * (1.0 - np.cos(pace * u)))
    phase = way_m / way.size
    return way.size * np.cos(phase), way.size * np.sin(phase), 0.0 * u


def _climb(way: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    phase = way.speed / way.size * u
    return 0.7 * way.size * np.sin(0.5 * phase), 0.0 * u, way.size * (1.0 - np.cos(phase))


def _vertical(way: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return 0.0 * u, 0.0 * u, way.size * (1.0 - np.cos(way.speed / way.size * u))


def _punches(way: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    # 0.25 m at 1.1 Hz changes the thrust by more than its mean.
    phase, beat = way.speed / way.size * u, 2.0 * np.pi * 1.1 * u
    return way.size * np.cos(phase), way.size * np.sin(phase), 0.18 * np.sin(beat)


def _chirp(way: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    def sweep(first_hz: float, last_hz: float) -> np.ndarray:
        slope = (last_hz - first_hz) / way.duration_s
        pace = 2.0 * np.pi * (first_hz + slope * u)
        return 0.5 * way.speed / pace * np.sin(2.0 * np.pi * (first_hz + 0.5 * slope * u) * u)

    return sweep(0.3, 1.4), sweep(0.4, 1.6), 0.5 * sweep(0.5, 2.2)


def _low(way: Trajectory, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    phase = way.speed / way.size * u
    return way.size * np.sin(phase), 0.0 * u, 0.4 * way.height * np.sin(1.3 * u)


KINDS: dict[str, Path] = {
    "hover": _hover,
    "figure_eight": _figure_eight,
    "circle": _circle,
    "speed_range": _speed_range,
    "climb": _climb,
    "vertical": _vertical,
    "punches": _punches,
    "chirp": _chirp,
    "low": _low,
}
"""Paths over eased time, around their own origin."""

_TURNS: dict[str, Callable[[Trajectory, np.ndarray], np.ndarray]] = {
    "fixed": lambda way, t: 0.0 * t,
    "sweep": lambda way, t: way.yaw_rate * t,
    "wobble": lambda way, t: way.yaw_rate / 1.7 * (1.0 - np.cos(1.7 * t)),
}


def ordinary_flights(rng: np.random.Generator, duration_s: float = 10.0) -> list[Trajectory]:
    """Return five flights that between them excite everything: eights, speeds, climbs, chirps."""

    def drawn(kind: str, **numbers: tuple[float, float]) -> Trajectory:
        given = {key: float(rng.uniform(*span)) for key, span in numbers.items()}
        direction = float(rng.uniform(0.0, 2.0 * np.pi))
        return replace(Trajectory(kind, duration_s), direction=direction, **given)

    return [
        replace(drawn("figure_eight", speed=(4, 7), size=(3, 5)), turn="wobble"),
        replace(drawn("speed_range", speed=(6, 9), size=(5, 8), height=(1, 3)), turn="sweep"),
        drawn("climb", speed=(2, 4), size=(1.5, 3)),
        replace(drawn("chirp", speed=(1.0, 1.6)), turn="wobble"),
        drawn("low", speed=(0.8, 1.5), size=(1, 2), height=(0.1, 0.16)),
    ]


def long_flights(rng: np.random.Generator, count: int = 3) -> list[Trajectory]:
    """Return `count` flights of a minute, for what changes slowly."""
    return [
        Trajectory(
            "figure_eight",
            duration_s=60.0,
            speed=float(rng.uniform(3, 6)),
            size=float(rng.uniform(3, 5)),
            direction=float(rng.uniform(0.0, 2.0 * np.pi)),
            turn="wobble",
        )
        for _ in range(count)
    ]

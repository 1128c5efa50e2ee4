"""What a flight did on its way from gate to gate: how far, how slow, and how often around."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eval.logs.flight import Flight

STANDS = 0.3
"""Below this speed a heading means nothing [m/s]."""


class Leg(NamedTuple):
    """The way to a gate, from the one before or from the start."""

    gate: int
    """The gate's number, from 0."""
    time_s: float
    """[s]."""
    path_m: float
    """Flown [m]."""
    slowest: float
    """Least speed, not counting the start from rest [m/s]."""
    turns: float
    """By how much the flight's direction turned from beginning to end, seen from above: 1 is a
    whole circle; to and fro cancels."""


def legs(flight: Flight) -> list[Leg]:
    """Return every leg that ended at its gate, in order."""
    if not len(flight.time_s):
        return []
    speed = np.linalg.norm(flight.vel_w, axis=-1)
    ahead = np.unwrap(_kept(np.arctan2(flight.vel_w[:, 1], flight.vel_w[:, 0]), speed > STANDS))
    step_m = np.linalg.norm(np.diff(flight.pos_w, axis=0), axis=-1)
    found, begin = [], 0
    for gate in range(int(flight.gate.max())):
        end = int(np.argmax(flight.gate > gate))
        off = begin if begin else int(np.argmax(speed > STANDS))
        found.append(
            Leg(
                gate,
                float(flight.time_s[end] - flight.time_s[begin]),
                float(step_m[begin:end].sum()),
                float(speed[off : end + 1].min()),
                float(abs(ahead[end] - ahead[off]) / (2 * np.pi)),
            )
        )
        begin = end
    return found


def _kept(angle: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return angles (T,) where those that are not known are the last ones that are."""
    last = np.maximum.accumulate(np.where(known, np.arange(len(angle)), 0))
    return angle[last]

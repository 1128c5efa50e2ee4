"""Which motors turn the body which way: the signs of a firmware's mixer, from the rotors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eval.vehicles.vehicle import Rotors
from tracks.geometry.scene import Array


class Layout(NamedTuple):
    """Shares (4,) of each motor, up to 1, in turning the body about its axes (FLU)."""

    roll: Array
    pitch: Array
    yaw: Array


def layout_of(rotors: Rotors) -> Layout:
    """Return the layout of `rotors`: arms over the longest arm, and against the spin."""
    x, y, _ = np.asarray(rotors.position, dtype=float).T
    spin = np.asarray(rotors.spin, dtype=float)
    return Layout(y / np.max(np.abs(y)), -x / np.max(np.abs(x)), -spin)

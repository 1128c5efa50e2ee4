"""Frames of the link: MAVLink's NED world and FRD body beside ours, z up and FLU.

North is our x, east minus our y, down minus our z; forward, right and down likewise. So both
changes of frame are the same half turn about x, and each is its own inverse.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eval.importers.frames import HALF_TURN, QUAT_HALF_TURN


def turned(vector: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return a vector (3,) of one world or body frame in the other convention."""
    return np.asarray(vector, float) * HALF_TURN


def turned_quat(quat_wxyz: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return an attitude (4,), body to world, wxyz, in the other convention."""
    return np.asarray(quat_wxyz, float) * QUAT_HALF_TURN

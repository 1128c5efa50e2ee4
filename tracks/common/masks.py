"""Work that a mask makes needless: left out of numpy's steps, and of no program that JAX compiles.

A traced mask holds nothing yet, and a compiled program is the same whatever it holds.
"""

from __future__ import annotations

import numpy as np

from tracks.geometry.scene import Array


def everywhere(mask: Array) -> bool:
    """Return whether a numpy `mask` is known to hold in all rows; False of one of JAX."""
    return isinstance(mask, np.ndarray) and bool(mask.all())


def nowhere(mask: Array) -> bool:
    """Return whether a numpy `mask` is known to hold in no row; False of one of JAX."""
    return isinstance(mask, np.ndarray) and not mask.any()

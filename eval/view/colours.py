"""Colours of pictures, recordings and videos."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import ListedColormap

AHEAD, PASSED = (217, 130, 43), (42, 143, 91)
"""Colours of gates ahead and of passed gates. All colours of this file are red, green and blue from
0 to 255."""
CRASH, START = (208, 47, 47), (31, 59, 115)
"""Colours of the end of a failed flight, and of the start."""
SOLID, SOLID_EDGE = (201, 206, 214), (138, 147, 160)
"""Colours of obstacles, and of their edges."""
DRONE = (40, 44, 52)
"""Colour of the drone and of texts."""
AXES = ((220, 60, 60), (60, 160, 70), (60, 100, 220))
"""Colours of the axes x, y and z."""

LIGHT_W = np.array([0.35, -0.45, 0.82]) / np.linalg.norm([0.35, -0.45, 0.82])
"""Unit vector towards the light, world axes."""
SPEED_MAP = ListedColormap(colormaps["plasma"](np.linspace(0, 0.9, 256)))
"""Colour map of speeds: plasma without yellow, which is hard to see on white."""
DEPTH_MAP = colormaps["turbo"]
"""Colour map of depths."""


def hex_text(colour: tuple[int, int, int]) -> str:
    """Return a colour (0-255) as text "#rrggbb" for matplotlib."""
    return "#" + "".join(f"{part:02x}" for part in colour)


def speed_colours(speed: np.ndarray, top: float) -> np.ndarray:
    """Return colours (..., 3) uint8 of speeds (...,) up to `top` [m/s]."""
    return SPEED_MAP(np.clip(speed / top, 0, 1), bytes=True)[..., :3]


def top_speed(speed: np.ndarray) -> float:
    """Return the upper end of the colour scale for these speeds, at least 1 [m/s]."""
    return max(1.0, float(np.nanmax(speed, initial=1.0)))


def brightness(normals_w: np.ndarray) -> np.ndarray:
    """Return the brightness (...,) of faces with unit normals (..., 3), 0.44 to 1."""
    return 0.72 + 0.28 * (normals_w @ LIGHT_W)


def depth_colours(depth_m: np.ndarray, range_m: float) -> np.ndarray:
    """Return colours (..., 3) uint8 of planar depths (...,) [m]: near is red, far is blue."""
    return DEPTH_MAP(1 - np.clip(depth_m / range_m, 0, 1), bytes=True)[..., :3]

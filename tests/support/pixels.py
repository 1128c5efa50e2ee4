"""Colours of pictures, for tests of what was painted."""

import numpy as np
from PIL import Image


def opened(path):
    """The picture in a file."""
    with Image.open(path) as image:
        return image.convert("RGB")


def share(image, colour, tolerance=12):
    """The share of pixels near a colour."""
    away = np.abs(np.asarray(image, dtype=int) - np.array(colour)).max(axis=-1)
    return float((away <= tolerance).mean())

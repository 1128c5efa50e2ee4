"""Random numbers for sensor models: with NumPy from a trial's generator, with JAX from a key."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from eval.sensors.interface import Draws, Needs, Sensor
from tracks.geometry.camera import Camera

if TYPE_CHECKING:
    import jax


def blank_draws(needs: Needs, rows: int, camera: Camera) -> Draws:
    """Return empty arrays for the draws `needs` of `rows` rows."""
    shape = camera.height, camera.width
    return Draws(
        np.zeros((rows, needs.normal)),
        np.zeros((rows, needs.uniform)),
        np.zeros((rows, needs.grain, *shape)),
        np.zeros((rows, needs.chance, *shape)),
    )


def blank_of_each(
    models: Iterable[Sensor], rows: int, camera: Camera
) -> tuple[dict[str, Draws], dict[str, Draws]]:
    """Return empty arrays for the draws of a trial and of an observation, by model."""
    each = list(models)
    trial = {one.name: blank_draws(one.trial, rows, camera) for one in each}
    return trial, {one.name: blank_draws(one.observation, rows, camera) for one in each}


def draw(into: Draws, row: int, generator: np.random.Generator) -> None:
    """Draw one row's numbers of one observation."""
    for numbers, normal in zip(into, (True, False, True, False), strict=True):
        if numbers[row].size:
            fill = generator.standard_normal if normal else generator.random
            fill(out=numbers[row])


def keyed_draws(needs: Needs, key: jax.Array, camera: Camera) -> Draws:
    """Return one row's numbers of one observation from a JAX `key`."""
    import jax

    shape = camera.height, camera.width
    keys = jax.random.split(key, 4)
    return Draws(
        jax.random.normal(keys[0], (needs.normal,)),
        jax.random.uniform(keys[1], (needs.uniform,)),
        jax.random.normal(keys[2], (needs.grain, *shape)),
        jax.random.uniform(keys[3], (needs.chance, *shape)),
    )

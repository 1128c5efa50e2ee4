"""Random numbers for sensor models, from a NumPy generator or a JAX key.

The judge, which flies and scores policies, draws with NumPy from each trial's seed, into arrays
that it allocates once. The trainer draws with JAX.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from eval.sensors.interface import Draws, Needs, Sensor
from tracks.geometry.camera import Camera

if TYPE_CHECKING:
    import jax


def blank_draws(needs: Needs, rows: int, camera: Camera) -> Draws:
    """Return arrays of zeros for the draws `needs` of `rows` drones."""
    shape = camera.height, camera.width
    return Draws(
        np.zeros((rows, needs.normal)),
        np.zeros((rows, needs.uniform)),
        np.zeros((rows, needs.grain, *shape)),
        np.zeros((rows, needs.chance, *shape)),
    )


def blank_model_draws(
    models: Iterable[Sensor], rows: int, camera: Camera
) -> tuple[dict[str, Draws], dict[str, Draws]]:
    """Return arrays of zeros for the draws of a trial and of an observation, by model."""
    models = list(models)
    trial = {model.name: blank_draws(model.trial, rows, camera) for model in models}
    observation = {model.name: blank_draws(model.observation, rows, camera) for model in models}
    return trial, observation


def draw(into: Draws, row: int, generator: np.random.Generator) -> None:
    """Draw the random numbers of drone `row`, in place: see `Draws` for the distributions."""
    fills = {
        "normal": generator.standard_normal,
        "uniform": generator.random,
        "grain": generator.standard_normal,
        "chance": generator.random,
    }
    for field, numbers in into._asdict().items():
        if numbers[row].size:
            fills[field](out=numbers[row])


def keyed_draws(needs: Needs, key: jax.Array, camera: Camera) -> Draws:
    """Return the random numbers of one drone from a JAX `key`."""
    import jax

    shape = camera.height, camera.width
    keys = jax.random.split(key, 4)
    return Draws(
        jax.random.normal(keys[0], (needs.normal,)),
        jax.random.uniform(keys[1], (needs.uniform,)),
        jax.random.normal(keys[2], (needs.grain, *shape)),
        jax.random.uniform(keys[3], (needs.chance, *shape)),
    )

"""Trainings that tests share: each of these programs is traced and compiled once in a process."""

from functools import cache

import jax

from suite.train.gradient import make_gradient
from suite.train.update import make_update
from tests.support.training import small_config

NOISY = small_config(physics={"depth_noise": 0.02})
"""Four worlds, six steps, noise in the images: what most tests of the trainer fly."""


@cache
def gradient_of(config):
    """Return the compiled gradient(params, worlds, key, delta) of a configuration."""
    return jax.jit(make_gradient(config))


@cache
def update_of(config):
    """Return the compiled update(state, worlds) of a configuration, as a run makes it."""
    return make_update(config)

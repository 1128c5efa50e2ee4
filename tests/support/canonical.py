"""Trainings that tests share: each of these programs is traced and compiled once in a process."""

from dataclasses import replace
from functools import cache
from unittest import mock

import jax
import jax.numpy as jnp

from policies.networks import network
from suite.train import shards, update
from suite.train.rollout import make_rollout
from tests.support.training import small_config

NOISY = small_config(physics={"depth_noise": 0.02}, shards=2)
"""Four worlds in two shards, six steps, noise in the images: what most tests of the trainer fly."""


@cache
def gradient_of(config):
    """Return the compiled gradient(params, worlds, key, delta) with the encoder in the loop."""
    rollout = make_rollout(config)

    def loss_of(params, *given):
        shift = jnp.zeros((config.episode.steps, config.episode.batch, config.spec.hidden_size))
        return rollout(params, shift, *given[:2], network.encode, given[2])

    def gradient(*given):
        (loss, records), found = jax.value_and_grad(loss_of, has_aux=True)(*given)
        return found, loss, records

    return jax.default_matmul_precision("highest")(jax.jit(gradient))


@cache
def shards_of(config):
    """Return the compiled shards of a configuration, for two cores."""
    with mock.patch.object(shards, "usable_cores", lambda: 2):
        return shards.make_shards(config)


@cache
def update_of(config):
    """Return the compiled update(state, worlds) of a configuration, as a run makes it."""
    made = shards_of(replace(config, optimizer=NOISY.optimizer))  # of any optimiser the same
    with mock.patch.object(update, "make_shards", lambda *_: made):
        return update.make_update(config)

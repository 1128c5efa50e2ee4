"""The trainer's benchmark: its worlds, the work of a step, and how fast ours is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from suite.experiments.bench import train
from tests.support.training import fresh_params
from tracks.geometry.scene import PARKED_Z


def test_every_world_has_64_solids_where_the_drone_flies():
    worlds = train.bench_worlds(train.bench_config(6, 12))
    kinds = (worlds.scene.boxes, *worlds.scene[2:5])
    assert sum(part.center_w.shape[1] for part in kinds) == 64 == sum(train.SOLIDS)
    for part in kinds:
        assert np.all(part.center_w[..., 2] > PARKED_Z / 2)
        assert all(np.all(np.isfinite(array)) for array in part)


def test_the_work_of_a_step_is_what_xla_counts():
    """One encoder forward and one recurrent step, within 5 %."""
    from policies.networks import network

    config = train.bench_config()
    assert 10e6 < train.work_per_step(config) < 13e6
    params = fresh_params(config.spec)
    image, hidden, state = jnp.zeros((1, 24, 32)), jnp.zeros((1, 192)), jnp.zeros((1, 12))

    def flops(f, *args):
        cost = jax.jit(f).lower(*args).compile().cost_analysis()
        assert cost is not None
        return cost["flops"]

    encoder = flops(network.encode, params, image)
    recurrent = flops(network.recur, params, hidden, hidden, state)
    assert train.work_per_step(config) == pytest.approx(4 * encoder + 3 * recurrent, rel=0.05)


@pytest.mark.slow
def test_ours_is_at_least_two_and_a_half_times_as_fast():
    result = train.run()
    assert result.details["solids"] == 64
    if result.warnings:
        pytest.skip(result.warnings[0])
    assert result.ratio >= 2.5

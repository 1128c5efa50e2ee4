"""Worlds of the next iterations: in order, each once, and not after the last."""

import threading

import pytest

from suite.train import worlds as sampling
from suite.train.worlds import WorldsAhead


def numbered(iteration):
    """Return worlds that say which iteration's they are."""
    return ("worlds", iteration)


@pytest.mark.parametrize("accelerator", [False, True], ids=["a thread", "processes"])
def test_every_iteration_comes_once_and_in_order(accelerator, monkeypatch):
    monkeypatch.setattr(sampling.jax, "default_backend", lambda: "gpu" if accelerator else "cpu")
    monkeypatch.setattr(sampling, "usable_cores", lambda: 3)
    with WorldsAhead() as worlds:
        found = list(worlds.worlds(numbered, 4, 9))
        assert found == [(k, ("worlds", k)) for k in range(4, 9)]
        # The next phase goes on with other worlds.
        assert list(worlds.worlds(numbered, 9, 10)) == [(9, ("worlds", 9))]


def test_the_next_worlds_are_sampled_while_the_devices_compute_and_none_beyond_the_end():
    begun, next_one = [], threading.Event()

    def sample(iteration):
        begun.append(iteration)
        if iteration == 1:
            next_one.set()
        return iteration

    with WorldsAhead() as worlds:
        for iteration, _ in worlds.worlds(sample, 0, 2):
            assert iteration or next_one.wait(10.0)
    assert begun == [0, 1]

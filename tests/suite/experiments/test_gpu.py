"""The page of an accelerator, at a small size on the CPU, and the operations that it counts."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest

from suite.experiments import gpu
from suite.experiments.study.speed import best_time, count_operations, multiplying_rate, peak_memory
from suite.train.recipes import named_recipe
from tests.support.documents import page, reproduce

SMALL = (
    *("--worlds", "2", "3", "--train-worlds", "2", "--seconds", "0.1", "--trials", "3"),
    *("--paired-trials", "3", "--timed-s", "0.2", "--matrix", "32"),
)


def short(name):
    """Return a recipe whose rollouts are six decisions long."""
    recipe = named_recipe(name)
    return replace(
        recipe,
        episode=replace(recipe.episode, steps=6),
        phases=(replace(recipe.phases[0], share=1.0, set=()),),
    )


@pytest.mark.slow
def test_the_page_has_speeds_a_training_and_the_cpus_outcomes(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu, "named_recipe", short)
    assert reproduce(tmp_path, "gpu", *SMALL) == 0
    text, numbers = page(tmp_path, "gpu")
    assert {(row["model"], row["worlds"]) for row in numbers["trainer"]} == {
        (model, worlds) for model in ("quadrotor", "point") for worlds in (2, 3)
    }
    assert all(row["seconds"] > 0 and row["operations"] > 1e6 for row in numbers["trainer"])
    assert [row["worlds"] for row in numbers["judge"]] == [2, 3]
    # On a CPU both sides are the same program.
    assert numbers["paired"]["mjx on the CPU"]["same_ending"] == 3
    training = numbers["training"]
    assert len(training["curve"]) == training["iterations"] >= 1
    assert "## A short training" in text


def test_worlds_that_are_repeated_have_numbers_of_their_own(monkeypatch):
    monkeypatch.setattr(gpu, "SAMPLED", 2)
    phase = gpu.last_phase(gpu.Config(), "quadrotor", 5)
    worlds = gpu.repeated_worlds(phase)
    assert worlds.number.tolist() == [0, 1, 2, 3, 4]
    assert (worlds.pos_w[0] == worlds.pos_w[2]).all() and (worlds.pos_w[0] != worlds.pos_w[1]).any()


A, B = jnp.ones((3, 4)), jnp.ones((4, 5))
IMAGES, KERNELS, SQUARE = jnp.ones((2, 1, 6, 6)), jnp.ones((3, 1, 3, 3)), jnp.ones((4, 4))
LOOPED = 6


def looped(a):
    return jax.lax.scan(lambda c, _: (c @ c, None), a, None, length=LOOPED)[0]


def product_or_not(a):
    return jax.lax.cond(a[0, 0] > 0, lambda a: a @ a, lambda a: a, a)


@pytest.mark.parametrize(
    ("function", "given", "operations"),
    [
        (lambda a, b: a @ b, (A, B), 2 * 3 * 4 * 5),
        (lambda a: a + 1.0, (A,), 12),
        (jax.jit(looped), (SQUARE,), LOOPED * 2 * 4**3),
        # 2 images of 1 x 6 x 6, 3 kernels of 1 x 3 x 3, at 4 x 4 places each.
        (lambda x, k: jax.lax.conv(x, k, (1, 1), "VALID"), (IMAGES, KERNELS), 2 * 2 * 3 * 16 * 9),
        (product_or_not, (SQUARE,), pytest.approx(2 * 4**3, abs=4)),
    ],
)
def test_operations_are_counted_by_hand(function, given, operations):
    assert count_operations(function, *given) == operations


def test_a_time_is_of_the_fastest_call_and_memory_is_of_this_process(monkeypatch):
    clock = iter([0.0, 3.0, 10.0, 11.0, 20.0, 25.0])
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    assert best_time(lambda: A, repeats=3) == 1.0
    monkeypatch.undo()
    assert peak_memory() > 1e7 and 1e6 < multiplying_rate(64) < 1e15

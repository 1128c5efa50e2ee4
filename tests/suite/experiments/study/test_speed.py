"""How many operations a program has, and what a device reaches."""

import jax
import jax.numpy as jnp
import pytest

from suite.experiments.study.speed import best_time, count_operations, multiplying_rate, peak_memory

A, B = jnp.ones((3, 4)), jnp.ones((4, 5))
LOOPED = 6


def looped(a):
    return jax.lax.scan(lambda c, _: (c @ c, None), a, None, length=LOOPED)[0]


@pytest.mark.parametrize(
    ("function", "given", "operations"),
    [
        (lambda a, b: a @ b, (A, B), 2 * 3 * 4 * 5),
        (lambda a: a + 1.0, (A,), 12),
        (looped, (jnp.ones((4, 4)),), LOOPED * 2 * 4**3),
        (jax.jit(looped), (jnp.ones((4, 4)),), LOOPED * 2 * 4**3),
        (
            # 2 images of 1 x 6 x 6, 3 kernels of 1 x 3 x 3, at 4 x 4 places each.
            lambda x, k: jax.lax.conv(x, k, (1, 1), "VALID"),
            (jnp.ones((2, 1, 6, 6)), jnp.ones((3, 1, 3, 3))),
            2 * 2 * 3 * 16 * 9,
        ),
        (
            lambda a: jax.lax.cond(a[0, 0] > 0, lambda a: a @ a, lambda a: a, a),
            (jnp.ones((4, 4)),),
            pytest.approx(2 * 4**3, abs=4),
        ),
    ],
)
def test_operations_are_counted_by_hand(function, given, operations):
    assert count_operations(function, *given) == operations


def test_a_time_is_of_the_fastest_call_and_memory_is_of_this_process(monkeypatch):
    clock = iter([0.0, 3.0, 10.0, 11.0, 20.0, 25.0])
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    assert best_time(lambda: A, repeats=3) == 1.0
    assert peak_memory() > 1e7


def test_a_product_of_matrices_is_some_operations_a_second():
    assert 1e6 < multiplying_rate(64) < 1e15

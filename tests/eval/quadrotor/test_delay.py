"""Late commands: what acts is what was given so long ago, and a delay has a slope."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.quadrotor.rotors import delay_weight, delayed, whole_steps

DT = 0.002


def test_rounding_makes_no_step():
    assert 0.043 / 0.001 < 43.0
    whole, part = whole_steps(np.array([0.043, 0.0, 0.0005]), 0.001)
    np.testing.assert_array_equal(whole, [43, 0, 0])
    np.testing.assert_allclose(part, [0.0, 0.0, 0.5], atol=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.002, 0.0047, 0.006])
def test_what_acts_is_the_line_through_what_was_given(delay):
    commands = np.random.default_rng(0).standard_normal((3, 12, 4))
    weight = delay_weight(np.asarray(delay), DT, 0.006)
    assert weight.shape == (4,) and weight.sum() == pytest.approx(1.0)
    past = np.repeat(commands[:, :1, :, None], 4, axis=-1)[:, 0]
    for k in range(12):
        past, now = delayed(weight, past, commands[:, k])
        if k >= 4:
            whole, part = divmod(delay / DT + 1e-9, 1.0)
            before = commands[:, k - int(whole)], commands[:, k - int(whole) - 1]
            np.testing.assert_allclose(now, (1 - part) * before[0] + part * before[1], atol=1e-7)


def test_no_delay_needs_no_memory():
    assert delay_weight(np.asarray(0.0), DT, 0.0).shape == (0,)


def test_a_delay_has_a_slope():
    past = jnp.arange(4.0)[::-1][None] ** 2  # newest first: 9, 4, 1, 0

    def acting(delay):
        return delayed(delay_weight(delay, DT, 0.006), past, jnp.full(1, 16.0))[1][0]

    # Between 1 and 2 steps late: from 3^2 to 2^2 in one step.
    np.testing.assert_allclose(jax.grad(acting)(0.003), (4.0 - 9.0) / DT, rtol=1e-5)

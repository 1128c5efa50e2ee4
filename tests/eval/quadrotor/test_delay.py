"""Late commands: the two forms of a delay say the same, and both can be fitted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.quadrotor.delay import delay_weight, delayed, delayed_series, whole_steps

DT = 0.002


def test_rounding_makes_no_step():
    assert 0.043 / 0.001 < 43.0
    whole, part = whole_steps(np.array([0.043, 0.0, 0.0005]), 0.001)
    np.testing.assert_array_equal(whole, [43, 0, 0])
    np.testing.assert_allclose(part, [0.0, 0.0, 0.5], atol=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.002, 0.0047, 0.006])
def test_step_by_step_is_as_all_at_once(delay):
    commands = np.random.default_rng(0).standard_normal((3, 12, 4))
    weight = delay_weight(np.asarray(delay), DT, 0.006)
    assert weight.shape == (4,) and weight.sum() == pytest.approx(1.0)
    past, acting = np.repeat(commands[:, :1, :, None], 4, axis=-1)[:, 0], []
    for k in range(12):
        past, now = delayed(weight, past, commands[:, k])
        acting.append(now)
    series = delayed_series(commands, np.asarray(delay), DT, 4)
    np.testing.assert_allclose(np.stack(acting, axis=1)[:, 4:], series, atol=1e-12)


def test_no_delay_needs_no_memory():
    assert delay_weight(np.asarray(0.0), DT, 0.0).shape == (0,)


def test_a_delay_has_a_slope():
    commands = jnp.arange(12.0)[None, :, None] ** 2
    slope = jax.jacobian(lambda delay: delayed_series(commands, delay, DT, 4)[0, 0, 0])(0.003)
    # Between 1 and 2 steps late: from 3^2 to 2^2 in one step.
    assert slope == pytest.approx((4.0 - 9.0) / DT, rel=1e-5)

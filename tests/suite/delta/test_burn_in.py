"""What the network saw before a window, and what it remembers of it."""

import jax
import numpy as np

from policies.networks import delta_network
from suite.delta.windows import BurnIn, burn_in_before, forgotten, state_after

STILL = np.tile(np.eye(3), (5, 1, 1))


def test_a_burn_in_ends_at_the_window_and_is_blank_before_the_flight():
    vel_w, action_b = np.arange(15.0).reshape(5, 3), -np.arange(15.0).reshape(5, 3)
    inputs, seen = burn_in_before(STILL, vel_w, action_b, first=2, count=3)
    np.testing.assert_array_equal(seen, [0, 1, 1])
    np.testing.assert_array_equal(inputs[0], np.zeros(9))
    np.testing.assert_array_equal(inputs[2], [*vel_w[1], 0, 0, 1, *action_b[1]])
    inputs, seen = burn_in_before(STILL, vel_w, action_b, first=4, count=3)
    assert seen.all()
    np.testing.assert_array_equal(inputs[:, :3], vel_w[1:4])


def test_what_was_not_seen_is_not_remembered():
    params = delta_network.init(jax.random.key(1))
    inputs = np.random.default_rng(0).normal(size=(2, 4, 9))
    late = BurnIn(inputs, np.tile([0.0, 0.0, 1.0, 1.0], (2, 1)))
    assert not np.any(state_after(params, BurnIn(inputs, np.zeros((2, 4)))))
    assert not np.any(state_after(None, late))
    found = state_after(params, late)
    assert np.abs(found).max() > 1e-3
    np.testing.assert_array_equal(
        found, state_after(params, BurnIn(inputs[:, 2:], late.seen[:, 2:]))
    )


def test_a_share_of_the_windows_forgets_what_it_saw():
    inputs = np.ones((5, 3, 9))
    part = forgotten(BurnIn(inputs, np.ones((5, 3))), 0.4)
    np.testing.assert_array_equal(part.seen, [[0.0] * 3] * 2 + [[1.0] * 3] * 3)
    assert forgotten(part, 0.0).seen.sum() == 9.0 and forgotten(part, 1.0).seen.sum() == 0.0
    np.testing.assert_array_equal(part.inputs, inputs)

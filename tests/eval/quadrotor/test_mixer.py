"""The mixer against thrusts worked by hand, and what it promises of any command."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eval.quadrotor.mixer import mix, mixer_matrix
from tests.support.vehicles import PLAIN

MATRIX = mixer_matrix(PLAIN.rotors.position, PLAIN.rotors.spin, 2.2e-8 / 1.6e-6)

UNMIXER = np.linalg.inv(MATRIX)

LIMIT = 7.056


def mixed(force, torque, limit=LIMIT):
    return mix(UNMIXER, limit, np.asarray(float(force)), np.asarray(torque, dtype=float))


@pytest.mark.parametrize(
    ("force", "torque", "expected"),
    [
        (8.0, [0.0, 0.0, 0.0], [2.0, 2.0, 2.0, 2.0]),
        # Each alone within range: arms 0.1 and 0.075 m, 0.01375 m of yaw torque a newton.
        (8.0, [0.4, 0.0, 0.0], [1.0, 1.0, 3.0, 3.0]),
        (8.0, [0.0, 0.3, 0.0], [1.0, 3.0, 3.0, 1.0]),
        (8.0, [0.0, 0.0, 0.055], [1.0, 3.0, 1.0, 3.0]),
        # Roll needs a collective of at least 10 N.
        (0.0, [1.0, 0.0, 0.0], [0.0, 0.0, 5.0, 5.0]),
        (100.0, [1.0, 0.0, 0.0], [2.056, 2.056, 7.056, 7.056]),
        # Roll and pitch shrink together until their spread is the whole range.
        (0.0, [2.0, 0.0, 0.0], [0.0, 0.0, 7.056, 7.056]),
        (8.0, [4.0, 3.0, 0.0], [0.0, 3.528, 7.056, 3.528]),
        # Yaw gets what is left, here half of it, then nothing.
        (4.0, [0.0, 0.0, 0.11], [0.0, 2.0, 0.0, 2.0]),
        (8.0, [4.0, 3.0, 0.5], [0.0, 3.528, 7.056, 3.528]),
        (0.0, [0.0, 0.0, 0.1], [0.0, 0.0, 0.0, 0.0]),
        (100.0, [0.0, 0.0, 0.0], [7.056] * 4),
    ],
)
def test_mix_by_hand(force, torque, expected):
    np.testing.assert_allclose(mixed(force, torque), expected, atol=1e-12)


NEWTONS = st.floats(-10.0, 60.0)

TORQUES = st.lists(st.floats(-5.0, 5.0), min_size=3, max_size=3)


@given(NEWTONS, TORQUES)
def test_mix_stays_in_range_and_keeps_directions(force, torque):
    thrust = mixed(force, torque)
    assert np.all((thrust >= 0.0) & (thrust <= LIMIT))
    given = MATRIX @ thrust
    np.testing.assert_allclose(given[1] * torque[1] - given[2] * torque[0], 0.0, atol=1e-9)
    assert given[1] * torque[0] >= -1e-9
    assert abs(given[3]) <= abs(torque[2]) + 1e-9
    exact = UNMIXER @ [force, *torque]
    if np.all((exact >= 0.0) & (exact <= LIMIT)):
        np.testing.assert_allclose(thrust, exact, atol=1e-12)
    # Yaw never costs thrust or tilt: without it they could not have been better.
    without = MATRIX @ mixed(force, [*torque[:2], 0.0])
    np.testing.assert_array_less(np.abs(without[1:3]), np.abs(given[1:3]) + 1e-9)
    assert abs(given[0] - force) <= abs(without[0] - force) + 1e-9


MIX_SLOPE = jax.jit(jax.jacobian(lambda f, t: mix(UNMIXER, LIMIT, f, t), argnums=(0, 1)))


@given(NEWTONS, TORQUES)
def test_mix_has_finite_gradients(force, torque):
    slope = MIX_SLOPE(jax.numpy.asarray(force), jax.numpy.asarray(torque))
    assert all(np.all(np.isfinite(part)) for part in slope)

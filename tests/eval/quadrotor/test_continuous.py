"""Steps of any length: order 2, MuJoCo's rule where it is asked for, steps that move nothing."""

import jax
import numpy as np
import pytest

from eval.quadrotor.continuous import Steps, fly
from eval.quadrotor.plant import Command, Motion, make_plant
from eval.quadrotor.stepper import Inputs, hover_state, rollout
from tests.support.vehicles import PLAIN, with_effects, with_lag

TRUTH = with_effects(with_lag(PLAIN, 0.03), linear_drag=((0.4, 0.5, 0.2),),
                     angular_damping=((0.5, 0.4, 0.3),))  # fmt: skip
DT = 0.002


ONES = np.ones((1, 3))
MOVING = Motion(0.0 * ONES, np.eye(3)[None], ONES, 0.0 * ONES)
by_jax = jax.jit(fly, static_argnums=6)


pytestmark = pytest.mark.usefixtures("float64")


def flown(length_s, integrator="continuous", duration_s=0.6):
    """Fly a turn with commands that change every 0.02 s, the loop looking as often."""
    plant, count = make_plant(TRUTH, DT), round(duration_s / length_s)
    time = np.arange(count) * length_s
    held = np.floor(time / 0.02 + 1e-9) * 0.02
    rate_b = np.stack([3 * np.sin(9 * held), 2 * np.cos(7 * held), 0.5 + 0 * held], axis=-1)
    command = Command((11 + 3 * np.sin(5 * held))[:, None], rate_b[:, None])
    looks = np.abs(time / 0.02 - np.rint(time / 0.02)) < 1e-9
    steps = Steps(*(x[:, None] for x in (0 * time + length_s, looks, 0 * time)))
    speed = hover_state(plant, (1,)).rotor_speed
    return by_jax(plant, MOVING, steps, Inputs(command), speed, np.zeros(1), integrator)


def end_of(flight):
    return np.concatenate([np.ravel(field[-1]) for field in flight.motion])


def test_half_the_step_is_a_quarter_of_the_error():
    fine = end_of(flown(0.000125))
    coarse, half = (np.abs(end_of(flown(h)) - fine).max() for h in (0.004, 0.002))
    assert coarse < 2e-3 and 3.0 < coarse / half < 5.0


def test_euler_steps_are_the_steppers():
    plant = make_plant(TRUTH, DT)
    rng = np.random.default_rng(0)
    thrust, rates = rng.uniform(8, 14, (200, 1)), rng.uniform(-3, 3, (200, 1, 3))
    inputs, state = Inputs(Command(thrust, rates)), hover_state(plant, (1,))
    ones = np.ones((200, 1))
    steps = Steps(DT * ones, ones > 0, 0.0 * ones)
    theirs = jax.jit(rollout)(plant, MOVING, inputs, state)
    ours = by_jax(plant, MOVING, steps, inputs, state.rotor_speed, np.zeros(1), "euler")
    np.testing.assert_allclose(end_of(ours), end_of(theirs), atol=1e-11)
    np.testing.assert_allclose(ours.acc_b, theirs.acc_b, atol=1e-10)


def test_a_step_of_no_length_moves_nothing():
    plant, zero = make_plant(TRUTH, DT), np.zeros((3, 1))
    inputs, start = Inputs(Command(zero + 20.0, np.ones((3, 1, 3)))), MOVING._replace(rate_b=ONES)
    speed, steps = hover_state(plant, (1,)).rotor_speed, Steps(zero, zero > 0, zero)
    flight = by_jax(plant, start, steps, inputs, speed, np.zeros(1), "continuous")
    for field, first in zip(flight.motion, start, strict=True):
        np.testing.assert_array_equal(field[-1], first)
    np.testing.assert_allclose(flight.rotor_speed[-1], speed, rtol=1e-6)

"""Gradients where a formula is written twice, for what is usual and for a limit, and around it.

A constant in the place of a limit has the right value and no slope: a training learns nothing from
it. Every function is compared with finite differences at its special states and beside them.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.quadrotor.attitude import (
    HEADING_RATE,
    action_to_force,
    attitude_command,
    blend_heading,
    level_heading,
)
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Controller
from suite.train.config import QuadrotorConfig
from suite.train.dynamics import quadrotor
from suite.train.dynamics.quadrotor import QuadrotorParams, quadrotor_dynamics
from tests.support.training import ALIKE, doubled
from tracks.geometry.field import attractive_field, magnetic_field
from tracks.geometry.gates import rectangle
from tracks.geometry.rotation import exp_rot

LEVEL, X = np.eye(3), np.array([1.0, 0.0, 0.0])
OPENING = np.asarray(rectangle(1.0, 1.0))
PADDED = np.concatenate([OPENING, OPENING[-1:], OPENING[-1:]])
"""A gate of four corners among gates of six."""


LOOP = Controller((20.0, 20.0, 8.0), 500.0, rate_max=(100.0, 100.0, 100.0))
"""An attitude loop whose rates are not clipped."""


def commanded(force_w):
    """Wanted force to body rates, upright."""
    return attitude_command(LOOP, force_w, jnp.asarray(LEVEL), jnp.asarray(X)).rate_b


def tilted(turn):
    """Small turn of the body to body rates, in hover."""
    force_w = action_to_force(jnp.zeros(3), exp_rot(turn))
    return attitude_command(LOOP, force_w, exp_rot(turn), jnp.asarray(X)).rate_b


def headed(to_gate_w):
    """Direction to the gate to the heading after a moment."""
    return blend_heading(jnp.asarray(X), to_gate_w, 0.5 / HEADING_RATE)


def from_rest(action_b):
    """Action to the velocity after three decisions from hover."""
    config = QuadrotorConfig(load_vehicle("reference"), 60.0, 60.0, **ALIKE)
    start, step = quadrotor_dynamics(config, 1 / 30, 0.0)
    effects = quadrotor.draw_effects(config, 1, np.random.default_rng(0))
    constants = QuadrotorParams(np.full(1, 1 / 30), doubled(effects))
    still = jnp.zeros((1, 3))
    body = start(constants, still + jnp.asarray([0.0, 0.0, 10.0]), still, jnp.asarray(X)[None])
    gate_w, key = jnp.asarray([[40.0, 0.0, 10.0]]), jax.random.key(0)

    def decide(body, _):
        return step(body, constants, action_b[None], gate_w, key), None

    return jax.lax.scan(decide, body, length=3)[0].vel_w[0]


def field_at(point_w, opening=OPENING):
    return magnetic_field(jnp.zeros(3), jnp.asarray(LEVEL), jnp.asarray(opening), point_w, 1.0)


def field_of_padded(point_w):
    return field_at(point_w, PADDED)


def level(turn):
    return level_heading(exp_rot(turn))


def pull_at_speed(vel_w):
    return attractive_field(field_at(jnp.asarray([-1.0, 0.2, 0.1])), vel_w, epsilon=1.0)


G = 9.80665
CASES = {
    "force, in hover": (commanded, (0.0, 0.0, G)),
    "force, nearly in hover": (commanded, (3e-6, -2e-6, G)),
    "force, far over": (commanded, (5.0, -3.0, 2.0)),
    "force, nearly upside down": (commanded, (1e-2, 2e-2, -G)),
    "turn, in hover": (tilted, (0.0, 0.0, 0.0)),
    "turn, nearly in hover": (tilted, (1e-7, -2e-7, 0.0)),
    "heading, gate aside and above": (headed, (0.0, 2.0, 3.0)),
    "heading, gate nearly behind": (headed, (-3.0, 0.1, 0.0)),
    "heading laid flat, level": (level, (0.0, 0.0, 0.0)),
    "rotation of nothing": (exp_rot, (0.0, 0.0, 0.0)),
    "rotation of little": (exp_rot, (9e-5, 0.0, 3e-5)),
    "field, beside a gate's centre": (field_at, (0.0, 0.1, 0.0)),
    "field, on a gate's axis": (field_at, (-1.5, 0.0, 0.0)),
    "field, beside a wire": (field_at, (1e-2, 0.5, 0.0)),
    "field, corners given twice": (field_of_padded, (-1.5, 0.3, 0.1)),
    "pull, at rest": (pull_at_speed, (0.0, 0.0, 0.0)),
    "pull, at speed": (pull_at_speed, (2.0, -0.5, 0.1)),
    "action, from rest": (from_rest, (0.0, 0.0, 0.0)),
}
STEP = 1e-4
"""Of the differences; where a state is special within less, they are the slope of its limit."""


@cache
def compiled(function):
    """Return the function's values and Jacobians at many points, one program for all its cases."""

    def both(point):
        value, pull = jax.vjp(lambda at: jnp.ravel(function(at)), point)
        return value, jax.vmap(pull)(jnp.eye(len(value)))[0]

    return jax.jit(jax.vmap(both))


@pytest.mark.parametrize("case", CASES)
def test_a_gradient_is_the_limit_of_differences(case):
    function, at = CASES[case]
    with jax.enable_x64(True):
        points = np.array(at) + STEP * np.concatenate([0 * LEVEL[:1], LEVEL, -LEVEL])
        values, jacobians = map(np.asarray, compiled(function)(points))
        found, (ahead, behind) = jacobians[0], np.split(values[1:], 2)
        wanted = np.moveaxis(ahead - behind, 0, -1) / (2 * STEP)
    assert np.abs(wanted).max() > 1e-3, "the case says nothing"
    np.testing.assert_allclose(found, wanted, rtol=2e-3, atol=2e-3 * np.abs(wanted).max())

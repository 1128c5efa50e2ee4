"""The equations shared by numpy and JAX take any leading batch shape: each row as if alone."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from eval.quadrotor.attitude import action_to_force, attitude_command, blend_heading, level_heading
from eval.quadrotor.mixer import mix, rate_torque
from eval.quadrotor.model import compile_quadrotor
from eval.quadrotor.plant import Motion, Wrench, accelerations, euler_step, make_plant
from eval.quadrotor.rotors import follow, speed_command
from eval.quadrotor.stepper import Inputs, hover_state, plant_step
from eval.quadrotor.vehicle_file import load_vehicle
from policies.observation import View, encode_depth, observe
from policies.spec import DepthEncoding, PolicySpec
from tests.support.vehicles import PLAIN, with_effects
from tracks.geometry.crossing import crossing, is_inside, is_near
from tracks.geometry.field import attractive_field, magnetic_field
from tracks.geometry.rotation import cross, exp_rot, quat_to_rot, rot_to_quat, to_local, to_world

VEHICLE = load_vehicle("reference")
PLANT = make_plant(VEHICLE, 0.002)


def commanded(force_w, rot_w, heading_w):
    return attitude_command(VEHICLE.controller, force_w, rot_w, heading_w)


def flown(pos_w, rot_w, vel_w, rate_b, thrust, rate_cmd_b):
    xp = pos_w.__array_namespace__()
    state, now = hover_state(PLANT, thrust.shape, xp), Motion(pos_w, rot_w, vel_w, rate_b)
    command = commanded(vel_w, rot_w, vel_w)._replace(thrust=thrust, rate_b=rate_cmd_b)
    state, wrench = plant_step(PLANT, state, now, Inputs(command), 0 * thrust)
    return state.rotor_speed, *wrench


def moved(pos_w, rot_w, vel_w, rate_b, force_b, torque_b):
    motion, wrench = Motion(pos_w, rot_w, vel_w, rate_b), Wrench(force_b, torque_b)
    return *accelerations(PLANT, motion, wrench), *euler_step(PLANT, motion, wrench)


def seen(pos_w, rot_w, vel_w, gate_w, second_w, axis_w, last_b):
    spec = PolicySpec(second_gate=True, gate_axis=True, second_axis=True)
    return observe(spec, View(pos_w, rot_w, vel_w, gate_w, second_w, axis_w, axis_w), last_b).state


# Shapes of one row of each argument: 3, 33 for (3, 3), 52 for a polygon's corners, - for a number.
FUNCTIONS = [
    (to_world, "33 3"),
    (to_local, "33 3"),
    (cross, "3 3"),
    (quat_to_rot, "4"),
    (rot_to_quat, "33"),
    (exp_rot, "3"),
    (is_inside, "52 2"),
    (is_near, "3 3"),
    (crossing, "3 33 52 3 3"),
    (magnetic_field, "3 33 52 3"),
    (attractive_field, "3 3"),
    (seen, "3 33 3 3 3 3 3"),
    (lambda depth_m: encode_depth(DepthEncoding(), depth_m, 10.0), "68"),
    (action_to_force, "3 33"),
    (commanded, "3 33 3"),
    (lambda heading_w, to_gate_w: blend_heading(heading_w, to_gate_w, 0.01), "3 3"),
    (level_heading, "33"),
    (lambda force, torque_b: mix(np.eye(4), 1.5, force, torque_b), "- 3"),
    (rate_torque, "3 3 3 3"),
    (lambda thrust: speed_command(thrust, 1.6e-6), "4"),
    (lambda speed, command, lag: follow(speed, command, lag, 0.002), "4 4 -"),
    (flown, "3 33 3 3 - 3"),
    (moved, "3 33 3 3 3 3"),
]


@pytest.mark.parametrize(
    ("function", "takes"), FUNCTIONS, ids=lambda part: getattr(part, "__name__", part)
)
def test_rows_of_any_batch_are_as_each_alone(function, takes):
    rng, shapes = np.random.default_rng(0), [tuple(map(int, s.strip("-"))) for s in takes.split()]
    arrays = [rng.uniform(0.1, 1.0, (2, 3, *shape)) for shape in shapes]
    whole = jax.tree.leaves(function(*arrays))
    alone = jax.tree.leaves(function(*(np.asarray(array[1, 2]) for array in arrays)))
    for many, one in zip(whole, alone, strict=True):
        assert many.shape == (2, 3, *np.shape(one))
        np.testing.assert_allclose(many[1, 2], one, rtol=1e-12, atol=1e-12)
    traced = jax.eval_shape(function, *(jnp.asarray(array, jnp.float32) for array in arrays))
    assert [part.shape for part in jax.tree.leaves(traced)] == [part.shape for part in whole]


def test_a_dead_motor_has_no_torque_and_leaves_the_model_finite():
    dead = with_effects(PLAIN, weak_motor=((0.0, 1.0, 1.0, 1.0),))
    gear = compile_quadrotor(mujoco.MjSpec(), dead, 0.002).actuator_gear
    assert np.isfinite(gear).all() and gear[0, 5] == 0.0 < abs(gear[1, 5])

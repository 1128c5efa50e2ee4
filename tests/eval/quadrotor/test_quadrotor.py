"""The equations shared by numpy and JAX take any leading batch shape and give the shapes they say.

A signature names the axes of every array, `*batch` being any number of leading ones; jaxtyping and
beartype hold arguments and results to it, so that an axis too many or one that broadcast is found.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beartype import beartype
from jaxtyping import Float, Shaped, jaxtyped

from eval.quadrotor.attitude import action_to_force, attitude_command, blend_heading, level_heading
from eval.quadrotor.mixer import mix, rate_torque
from eval.quadrotor.plant import Motion, Wrench, accelerations, euler_step, make_plant
from eval.quadrotor.rotors import follow, speed_command
from eval.quadrotor.stepper import Inputs, hover_state, plant_step
from eval.quadrotor.vehicle_file import load_vehicle
from policies.observation import View, encode_depth, observe
from policies.spec import DepthEncoding, PolicySpec
from suite.train.dynamics.point_mass import attitude
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


FUNCTIONS = {
    to_world: ("*batch 3 3, *batch 3", "*batch 3"),
    to_local: ("*batch 3 3, *batch 3", "*batch 3"),
    cross: ("*batch 3, *batch 3", "*batch 3"),
    quat_to_rot: ("*batch 4", "*batch 3 3"),
    rot_to_quat: ("*batch 3 3", "*batch 4"),
    exp_rot: ("*batch 3", "*batch 3 3"),
    is_inside: ("*batch corners 2, *batch 2", "*batch"),
    is_near: ("*batch 3, *batch 3", "*batch"),
    crossing: (
        "*batch 3, *batch 3 3, *batch corners 2, *batch 3, *batch 3",
        "*batch, *batch",
    ),
    magnetic_field: ("*batch 3, *batch 3 3, *batch corners 2, *batch 3", "*batch 3"),
    attractive_field: ("*batch 3, *batch 3", "*batch 3"),
    lambda pos_w, rot_w, vel_w, gate_w, second_w, axis_w, last_b: (
        observe(
            PolicySpec(second_gate=True, gate_axis=True, second_axis=True),
            View(pos_w, rot_w, vel_w, gate_w, second_w, axis_w, axis_w),
            last_b,
        ).state
    ): (
        "*batch 3, *batch 3 3, *batch 3, *batch 3, *batch 3, *batch 3, *batch 3",
        "*batch 21",
    ),
    lambda depth_m: encode_depth(DepthEncoding(), depth_m, 10.0): (
        "*batch height width",
        "*batch height width",
    ),
    action_to_force: ("*batch 3, *batch 3 3", "*batch 3"),
    commanded: ("*batch 3, *batch 3 3, *batch 3", "*batch, *batch 3"),
    lambda heading_w, to_gate_w: blend_heading(heading_w, to_gate_w, 0.01): (
        "*batch 3, *batch 3",
        "*batch 3",
    ),
    level_heading: ("*batch 3 3", "*batch 3"),
    mix: ("4 4, , *batch, *batch 3", "*batch 4"),
    rate_torque: ("*batch 3, *batch 3, *batch 3, *batch 3", "*batch 3"),
    lambda thrust: speed_command(thrust, 1.6e-6): ("*batch 4", "*batch 4"),
    lambda speed, command, lag: follow(speed, command, lag, 0.002): (
        "*batch 4, *batch 4, *batch",
        "*batch 4, *batch 4, *batch 4",
    ),
    flown: (
        "*batch 3, *batch 3 3, *batch 3, *batch 3, *batch, *batch 3",
        "*batch 4, *batch 3, *batch 3",
    ),
    moved: (
        "*batch 3, *batch 3 3, *batch 3, *batch 3, *batch 3, *batch 3",
        "*batch 3, *batch 3, *batch 3, *batch 3 3, *batch 3, *batch 3",
    ),
}
ONLY_JAX = {attitude: ("n 3, n 3", "n 3 3")}
SIZES = {"corners": 5, "height": 6, "width": 8, "n": 7}


def held_to(function, takes, gives):
    """Return `function` of a tuple of arrays, checked against both signatures."""

    def call(arrays):
        found = function(*arrays)
        return found if isinstance(found, tuple) else (found,)

    arguments = tuple(Float[Any, shape.strip()] for shape in takes.split(","))
    results = tuple(Shaped[Any, shape.strip()] for shape in gives.split(","))
    call.__annotations__ = {"arrays": tuple[arguments], "return": tuple[results]}
    return jaxtyped(typechecker=beartype)(call)


def inputs(takes, batch):
    rng = np.random.default_rng(0)
    shapes = [
        [
            size
            for axis in shape.split()
            for size in (batch if axis == "*batch" else [SIZES.get(axis) or int(axis)])
        ]
        for shape in takes.split(",")
    ]
    return tuple(np.asarray(rng.uniform(0.1, 1.0, shape)) for shape in shapes)


def named(function):
    return function.__name__


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)], ids=str)
@pytest.mark.parametrize("function", FUNCTIONS, ids=named)
def test_shapes_are_those_promised(function, batch):
    takes, gives = FUNCTIONS[function]
    arrays = inputs(takes, batch)
    call = held_to(function, takes, gives)
    call(arrays)
    jax.eval_shape(call, tuple(jnp.asarray(array, jnp.float32) for array in arrays))


@pytest.mark.parametrize("function", ONLY_JAX, ids=named)
def test_shapes_of_the_trainer(function):
    takes, gives = ONLY_JAX[function]
    jax.eval_shape(held_to(function, takes, gives), inputs(takes, ()))


def test_a_broken_promise_is_found():
    call = held_to(lambda a, b: (a * b).sum(-1), "*batch 3, *batch 3", "*batch 3")
    with pytest.raises(Exception, match="return"):
        call((np.ones((4, 3)), np.ones((4, 3))))
    call = held_to(cross, "*batch 3, *batch 3", "*batch 3")
    with pytest.raises(Exception, match="arrays"):
        call((np.ones((4, 3)), np.ones((1, 3))))

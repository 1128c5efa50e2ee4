"""The reduced quadrotor: parity with the judge's, exact steps, limits, gradients, old sensors."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from policies.spec import PolicySpec
from suite.train.dynamics import reduced
from suite.train.dynamics.fleet import FleetConfig, Vehicles
from tests.suite.train.dynamics.test_quadrotor import FAR_W, fly_judge, lively_actions
from tests.support.vehicles import PLAIN, with_effects, with_lag

PERIOD = 1 / 20
STILL = {
    "linear_drag": ((0.3, 0.2, 0.1),),
    "quadratic_drag": ((0.02, 0.01, 0.04),),
    "command_delay": (0.037,),
}
BENT = {**STILL, "com_offset": ((0.004, -0.003, 0.0),), "rate_gain": ((0.8, 0.8, 1.2),)}


def described(vehicle, batch):
    """Return `vehicle`, a symmetric X, as `batch` vehicles of a class."""
    effects = vehicle.effects
    inertia, rotors = np.asarray(vehicle.inertia), vehicle.rotors
    arm, f_max = np.abs(np.asarray(rotors.position)[0]), rotors.thrust_max
    offset = np.asarray(effects["com_offset"].offset) if "com_offset" in effects else np.zeros(3)
    scale = np.asarray(effects["rate_gain"].scale) if "rate_gain" in effects else np.ones(3)
    twist = rotors.torque_coefficient / rotors.thrust_coefficient
    one = Vehicles(
        time_step=np.float64(PERIOD),
        thrust_max=np.float64(4 * f_max / vehicle.mass),
        force_scale=np.float64(1.0),
        rotor_lag=np.float64(rotors.time_constant),
        delay=np.float64(effects["command_delay"].delay),
        rate_gain=scale * vehicle.controller.rate_gain,
        integral_gain=np.zeros(3),
        attitude_gain=np.asarray(vehicle.controller.attitude_gain),
        rate_max=np.asarray(vehicle.controller.rate_max),
        turn_max=2 * f_max * np.array([arm[1], arm[0], twist]) / inertia,
        turn_by_thrust=np.array([-offset[1], offset[0], 0.0]) * vehicle.mass / inertia,
        trim=np.zeros(3),
        drag=np.asarray(effects["linear_drag"].coefficient),
        quadratic=np.asarray(effects["quadratic_drag"].coefficient),
        wind_w=np.zeros(3),
        state_latency=np.float64(0.0),
        image_latency=np.float64(0.0),
    )
    return Vehicles(*(np.stack([np.asarray(x)] * batch) for x in one))


def flown(params, actions, steps, rates=False):
    """Return positions, attitudes and velocities from rest after each decision."""
    batch = actions.shape[1]
    still = jnp.zeros((batch, 3))
    towards = jnp.tile(jnp.asarray([1.0, 0.0, 0.0]), (batch, 1))
    body = reduced.start(params, still + jnp.asarray([0.0, 0.0, 10.0]), still, towards)
    target = jnp.tile(jnp.asarray(FAR_W), (batch, 1))

    @jax.jit
    def fly(body, actions):
        def one(body, action):
            body = reduced.step(body, params, action, target, steps, 0.0)
            return body, (body.pos_w, body.rot_w, body.vel_w)

        return jax.lax.scan(one, body, actions)[1]

    return [np.asarray(x) for x in fly(body, jnp.asarray(actions))]


@pytest.mark.parametrize(
    ("vehicle", "steps", "allowed_m"),
    [
        (with_effects(with_lag(PLAIN, 0.03), **STILL), 5, 0.02),
        (with_effects(with_lag(PLAIN, 0.03), **STILL), 3, 0.06),
        (with_effects(with_lag(PLAIN, 0.02), **BENT), 5, 0.03),
        (load_vehicle("reference"), 3, 0.06),
    ],
    ids=["plain", "coarse", "bent", "reference"],
)
def test_it_flies_what_the_judge_flies_to_a_hands_breadth(vehicle, steps, allowed_m):
    """2 s of up to 4 m/s^2 that turn around: metres of way."""
    actions = lively_actions(40)
    params = reduced.prepare(described(vehicle, 2), steps)
    ours, judged = flown(params, actions, steps), fly_judge(vehicle, actions, 20.0)
    assert np.ptp(judged[0], axis=0).max() > 1.0
    print(np.abs(ours[0] - judged[0]).max(), np.abs(ours[2] - judged[2]).max())
    assert np.abs(ours[0] - judged[0]).max() < allowed_m

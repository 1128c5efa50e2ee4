"""The trainer's quadrotor: parity with the judge, gradients, what varies, environments of it."""

import copy
import pickle
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.effects import EFFECTS
from eval.envs.gymnasium_env import RaceEnv, RaceVectorEnv
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.mujoco import MujocoWorld
from eval.worlds.slots import layout_of
from eval.worlds.trial import Rules, TrialSpec
from policies.networks import delta_network
from suite.train import losses
from suite.train.config import QuadrotorConfig
from suite.train.dynamics import point_mass, quadrotor
from suite.train.dynamics.interface import make_dynamics
from suite.train.dynamics.quadrotor import QuadrotorParams, quadrotor_dynamics, substeps
from suite.train.recipes import named_recipe, race_settings, with_quadrotor
from suite.train.worlds import sample_worlds
from tests.support.courses import straight
from tests.support.training import (
    ALIKE,
    assert_slopes,
    boxes_worlds,
    doubled,
    fresh_params,
    loss_of,
    small_config,
)
from tests.support.vehicles import PLAIN, drawn_effects, with_effects, with_lag
from tracks.geometry.camera import Camera

HIDDEN = with_effects(
    with_lag(PLAIN, 0.02),
    linear_drag=((0.3, 0.2, 0.1),),
    rotor_drag=(3e-5,),
    command_delay=(0.037,),
    com_offset=((0.01, -0.006, 0.0),),
    rate_gain=((0.6, 0.7, 1.2),),
)
"""Effects that a point mass cannot hold."""
FAR_W = np.array([40.0, 5.0, 3.0])
"""A gate that is never reached."""


def lively_actions(decisions, batch=2, seed=0):
    """Return actions (decisions, batch, 3) of some m/s^2 that turn around before the floor."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(0, 6.3, (batch, 3))
    wave = np.sin(0.5 * np.arange(decisions)[:, None, None] + phase)
    return wave * [4.0, 4.0, 1.5] + [0.0, 0.0, 0.5]


def fly_trainer(config, actions, rate_hz):
    """Return positions and attitudes of the trainer's quadrotor from rest after each decision."""
    start, step = quadrotor_dynamics(config, 1 / rate_hz, 0.0)
    batch = actions.shape[1]
    effects = quadrotor.draw_effects(config, batch, np.random.default_rng(0))
    constants = QuadrotorParams(np.full(batch, 1 / rate_hz), doubled(effects))
    places = ([1.0, 0.0, 0.0], FAR_W, [0.0, 0.0, 0.0], [0.0, 0.0, 10.0])
    towards, target, still, high = doubled([np.tile(place, (batch, 1)) for place in places])
    keys = jax.random.split(jax.random.key(0), batch)

    @jax.jit
    def fly(constants, actions):
        body = start(constants, high, still, towards)

        def one(body, action):
            body = step(body, constants, action, target, keys)
            return body, (body.pos_w, body.rot_w, body.vel_w)

        return jax.lax.scan(one, body, actions)[1]

    return [np.asarray(x) for x in fly(constants, actions)]


def fly_judge(vehicle, actions, rate_hz):
    """Return the same of the judge's MuJoCo world."""
    batch = actions.shape[1]
    track = straight(distances=(FAR_W[0],), height=10.0)
    gates = track.scene.gates._replace(center_w=FAR_W[None])
    track = replace(track, scene=track.scene._replace(gates=gates))
    world = MujocoWorld(vehicle, Camera(width=2, height=2), layout_of([track]), Rules(), batch)
    world.load([(k, track, TrialSpec("straight", 0, k)) for k in range(batch)])
    decided = np.rint(np.arange(len(actions) + 1) / (rate_hz * world.dt)).astype(int)
    rows = []
    for action, steps in zip(actions, np.diff(decided), strict=True):
        world.advance(action, np.full(batch, steps), record=False)
        seen = world.view(np.zeros(batch, bool))
        rows.append((seen.pos_w, seen.rot_w, seen.vel_w))
    assert not world.progress.ended.any(), "the flight must be free"
    return [np.stack(column) for column in zip(*rows, strict=True)]


def test_on_the_judges_steps_the_trainers_quadrotor_flies_the_judges_flight(float64):
    """At 20 Hz a period is 5 steps of the judge's attitude loop, 25 of its physics."""
    config = QuadrotorConfig(HIDDEN, physics_hz=500.0, **ALIKE)
    assert substeps(config, 0.05) == (5, 5, 0.002)
    racing = substeps(QuadrotorConfig(HIDDEN, 60.0, 120.0), 1 / 15)
    assert racing == (4, 2, pytest.approx(1 / 120)), "no more than a period at other rates"
    actions = lively_actions(40)
    ours, judged = fly_trainer(config, actions, 20.0), fly_judge(HIDDEN, actions, 20.0)
    assert np.ptp(judged[0], axis=0).max() > 1.0 and judged[1][..., 2, 2].min() < 0.95
    for one, two in zip(ours, judged, strict=True):
        # Both in double precision; effects are drawn in single, which is what is left.
        np.testing.assert_allclose(one, two, atol=2e-5)


@pytest.mark.extended
def test_the_default_recipe_draws_vehicles_that_fly():
    """A second of mild actions tips none over, around the lightest of the shipped vehicles."""
    config = with_quadrotor(named_recipe("race"), load_vehicle("crazyflie21")).quadrotor
    actions = 0.5 * lively_actions(15, batch=64)
    pos_w, rot_w, _ = fly_trainer(config, actions, 15.0)
    assert np.isfinite(pos_w).all() and rot_w[..., 2, 2].min() > 0.5


@pytest.mark.extended
def test_the_rollouts_gradient_is_that_of_finite_differences(float64, monkeypatch):
    """Where nothing is cut, heading held, with a Delta Action network, which sees the attitude.

    tests/test_gradients.py has that of three decisions by the action.
    """
    monkeypatch.setattr(quadrotor, "blend_heading", lambda heading_w, *_: heading_w)
    monkeypatch.setattr(losses, "BARRIER_SLOPE", -4.0)  # smooth enough for differences
    free = {"gradient_decay": 0.0, "field_gain": 0.0, "collide": 0.0}
    config = small_config(batch=2, steps=5, loss=free)
    config = replace(config, quadrotor=QuadrotorConfig(HIDDEN, 100.0, 100.0))
    params, worlds = doubled(fresh_params()), doubled(boxes_worlds(config))
    worlds = worlds._replace(vel_w=4.0 * worlds.heading_w)
    delta = doubled(delta_network.init(jax.random.key(1)))
    delta["output.weight"] += 1.5 * jax.random.normal(jax.random.key(2), (delta_network.HIDDEN, 3))
    both = jax.jit(jax.value_and_grad(loss_of(config)))
    names = ("state.weight", "gru.weight_hidden", "action.weight")

    def along(params, way):
        loss, gradient = both(params, worlds, delta)
        return loss, sum((gradient[name] * way[name]).sum() for name in names)

    assert_slopes(along, params, names, 1e-6, rel=1e-4)


def test_gradients_of_the_motion_fade_as_those_of_the_point_mass(float64, monkeypatch):
    """In a step by e^(-alpha dt), whichever part of the motion they come through.

    The motion that flies a period stays as it is here, so that a gradient is what has faded.
    """
    monkeypatch.setattr(quadrotor, "fly_period", lambda vehicle, plant, steps, body, *_: body)
    config, still = QuadrotorConfig(PLAIN, **ALIKE), jnp.zeros((1, 3))
    constants = QuadrotorParams(np.full(1, 0.05), doubled(drawn(config, 1)))
    start, step = quadrotor_dynamics(config, 0.05, 0.916)
    keys, ahead = jax.random.split(jax.random.key(0), 1), jnp.asarray([[1.0, 0.0, 0.0]])
    body = jax.jit(start)(constants, still, 3 * ahead, ahead)

    def after(motion):
        end = step(body._replace(**motion), constants, still, still + 5.0, keys)
        return {name: getattr(end, name).ravel() for name in motion}

    motion = {name: getattr(body, name) for name in ("pos_w", "vel_w", "rot_w", "rate_b")}
    end, slopes = jax.jit(lambda motion: (after(motion), jax.jacrev(after)(motion)))(motion)
    for name, value in motion.items():
        np.testing.assert_allclose(end[name], value.ravel(), rtol=1e-12, err_msg="no value fades")
        slope = slopes[name][name].reshape(value.size, value.size)
        np.testing.assert_allclose(slope, np.exp(-0.916 * 0.05) * np.eye(value.size), atol=1e-12)


def drawn(config, batch, seed=0):
    return quadrotor.draw_effects(config, batch, np.random.default_rng(seed))


def test_quadrotors_vary_around_the_vehicle_and_the_tracks_stay_the_same():
    point = small_config(batch=64)
    quad = replace(point, quadrotor=QuadrotorConfig(HIDDEN))
    one, two, again = sample_worlds(point, 3), sample_worlds(quad, 3), sample_worlds(quad, 3)
    np.testing.assert_array_equal(one.pos_w, two.pos_w)
    np.testing.assert_array_equal(one.scene.boxes.center_w, two.scene.boxes.center_w)
    jax.tree.map(np.testing.assert_array_equal, two, again)
    assert isinstance(two.constants, QuadrotorParams)
    effects = two.constants.effects
    for name, value in effects.items():
        assert all(len(field) == 64 and np.ptp(field, axis=0).min() > 0 for field in value), name
    delay, drag = effects["command_delay"].delay, effects["linear_drag"].coefficient
    assert delay.mean() == pytest.approx(0.037, abs=0.003)
    assert np.all(np.abs(delay - 0.037) <= 0.01 + 1e-6) and np.all(drag >= 0)
    assert effects["motor_lag"].time_constant.mean() == pytest.approx(0.02, rel=0.1)
    np.testing.assert_allclose(effects["rate_gain"].scale.mean(0), [0.6, 0.7, 1.2], rtol=0.05)
    np.testing.assert_allclose(drag.mean(0), [0.3, 0.2, 0.1], atol=0.03)
    assert "com_offset" not in effects, "what does not vary stays the vehicle's"


def test_draws_stay_within_what_a_vehicle_can_have_and_move_no_other_draw():
    bare = drawn(QuadrotorConfig(PLAIN), 8)
    assert np.all(bare["motor_lag"].time_constant == 0), "a share of no lag is none"
    assert np.all((bare["command_delay"].delay >= 0) & (bare["command_delay"].delay <= 0.01))
    wide = drawn(QuadrotorConfig(PLAIN, lag_spread_s=0.05, mass_std=0.9), 200)
    lag, offset = wide["motor_lag"].time_constant, wide["mass_offset"].offset
    assert lag.min() == 0 and 0.045 < lag.max() <= 0.05
    assert offset.min() == pytest.approx(-0.5 * PLAIN.mass) and np.ptp(offset) > PLAIN.mass
    own = {
        "com_offset": EFFECTS["com_offset"].values(np.array([0.006, 0.0, 0.001])),
        "thrust_scale": EFFECTS["thrust_scale"].values(np.float64(0.9)),
    }
    config = QuadrotorConfig(replace(PLAIN, effects={**PLAIN.effects, **own}))
    spreads = {"thrust_spread": 0.2, "com_std_m": 0.004, "trim_std": 0.02, "lag_spread_s": 0.05}
    before, after = drawn(config, 500, 1), drawn(replace(config, **spreads), 500, 1)
    assert set(after) - set(before) == {"thrust_scale", "com_offset", "torque_trim"}
    for name in before.keys() - {"motor_lag"}:
        np.testing.assert_array_equal(before[name][0], after[name][0])
    scale, (offset,) = after["thrust_scale"].scale, after["com_offset"]
    assert 0.72 <= scale.min() < 0.75 and 1.05 < scale.max() <= 1.08
    np.testing.assert_allclose(offset.mean(0), [0.006, 0.0, 0.001], atol=6e-4)
    np.testing.assert_allclose(offset.std(0), [0.00384, 0.00384, 0.0], atol=3e-4)
    assert np.abs(offset[:, 1]).max() <= 0.008 + 1e-6
    torque = after["torque_trim"].torque
    np.testing.assert_allclose(torque.std(0), [0.0192, 0.0192, 0.00384], rtol=0.08)


@pytest.mark.extended
def test_effects_of_every_kind_fly_in_training_together():
    drawn = drawn_effects(np.random.default_rng(0)).effects
    effects = {name: values for name, values in drawn.items() if EFFECTS[name].in_flight}
    alike = {**ALIKE, "drag_spread": 0.3}
    config = QuadrotorConfig(replace(PLAIN, effects=effects), 60.0, 60.0, **alike)
    pos_w, plainly_w = (
        fly_trainer(one, lively_actions(7), 15.0)[0]
        for one in (config, replace(config, vehicle=PLAIN))
    )
    assert np.isfinite(pos_w).all() and np.abs(pos_w - plainly_w).max() > 0.01


CONFIG = small_config(batch=2, loss={"gradient_decay": 0.4})


def stepped(config):
    """Return worlds, the state before a step, its inputs, and the state after it."""
    worlds, dynamics = sample_worlds(config, 0), make_dynamics(config)
    body = jax.jit(dynamics.start)(worlds.constants, *worlds[1:4])
    now = worlds.constants, jnp.asarray([[1.0, 0.5, 2.0]] * 2), jnp.asarray([[9.0, 1.0, 2.0]] * 2)
    keys = jax.random.split(jax.random.key(0), 2)
    return worlds, body, now, jax.jit(dynamics.step)(body, *now, keys)


def test_point_mass_and_quadrotor_are_stepped_by_one_interface_with_the_runs_settings():
    worlds, body, now, found = stepped(CONFIG)
    assert isinstance(worlds.constants, point_mass.PointMassParams)
    expected = jax.jit(point_mass.step)(body, *now, 0.4)
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    config = replace(CONFIG, quadrotor=QuadrotorConfig(PLAIN))
    worlds, body, _, after = stepped(config)
    np.testing.assert_allclose(body.rot_w[:, 2, 2], 1.0, atol=1e-6, err_msg="upright")
    np.testing.assert_allclose(worlds.constants.time_step, 1 / config.spec.rate_hz, rtol=1e-6)
    moved = np.asarray(after.pos_w - body.pos_w)
    assert np.abs(moved - worlds.vel_w / config.spec.rate_hz).max() < 0.05
    assert np.all(after.vel_w[:, 2] > body.vel_w[:, 2]) and after.acc_w.shape == (2, 3)


def test_environments_draw_their_vehicles_as_the_trainer_does():
    settings = race_settings("race")
    drawn, config = settings["vehicle"], settings["vehicle"].config
    rng = np.random.default_rng(0)
    many = [drawn(rng) for _ in range(60)]
    mass = np.array([vehicle.effects["mass_offset"].offset for vehicle in many])
    assert mass.std() == pytest.approx(config.mass_std * config.vehicle.mass, rel=0.3)
    assert copy.deepcopy(drawn) == pickle.loads(pickle.dumps(drawn)) == drawn


def test_vehicles_fly_at_once_as_they_fly_alone_where_they_differ_in_effects_alone():
    settings = {**race_settings("race"), "track": "circular", "rules": Rules(0.3)}
    many = RaceVectorEnv(3, **settings)
    alone = [RaceEnv(**settings) for _ in range(3)]
    seen, _ = many.reset(seed=5)
    states = [env.reset(seed=5 + k)[0]["state"] for k, env in enumerate(alone)]
    action = np.array([0.3, 0.1, 0.1], np.float32)
    for _ in range(12):
        assert np.array_equal(seen["state"], states)
        seen, _, terminated, truncated, _ = many.step(np.tile(action, (3, 1)))
        states = [env.step(action)[0]["state"] for env in alone]
        for k in np.flatnonzero(terminated | truncated):
            states[k] = alone[k].reset()[0]["state"]
    speeds = np.linalg.norm(seen["state"][:, :3], axis=-1)
    assert len(set(speeds.round(4).tolist())) == 3
    names = iter(("racer5", "racer5", "reference"))
    env = RaceVectorEnv(2, vehicle=lambda rng: load_vehicle(next(names)))
    with pytest.raises(ValueError, match="the function drew name reference after racer5"):
        env.reset(seed=0)

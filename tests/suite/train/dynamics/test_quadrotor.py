"""The trainer's quadrotor: parity with the judge, gradients, and what varies between worlds."""

from dataclasses import fields, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.effects import EFFECTS
from eval.effects.interface import neutral
from eval.quadrotor.vehicle_file import load_vehicle, shipped_vehicles
from eval.worlds.mujoco import MujocoWorld
from eval.worlds.slots import layout_of
from eval.worlds.trial import Rules, TrialSpec
from policies.networks import delta_network
from suite.train import losses
from suite.train.config import QuadrotorConfig
from suite.train.dynamics import quadrotor
from suite.train.dynamics.quadrotor import QuadrotorParams, quadrotor_dynamics, substeps
from suite.train.recipes import named_recipe, with_quadrotor
from suite.train.rollout import make_rollout
from suite.train.worlds import sample_worlds
from tests.support.courses import straight
from tests.support.training import (
    ALIKE,
    SPEC,
    boxes_worlds,
    doubled,
    fresh_params,
    small_config,
)
from tests.support.vehicles import PLAIN, with_effects, with_lag
from tracks.geometry.camera import Camera

REFERENCE = load_vehicle("reference")
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


@pytest.mark.parametrize(
    "vehicle",
    [pytest.param(REFERENCE, marks=pytest.mark.slow), HIDDEN],
    ids=["reference", "hidden"],
)
def test_on_the_judges_steps_the_trainers_quadrotor_flies_the_judges_flight(float64, vehicle):
    """At 20 Hz a period is 5 steps of the judge's attitude loop, 25 of its physics."""
    config = QuadrotorConfig(vehicle, physics_hz=500.0, **ALIKE)
    assert substeps(config, 0.05) == (5, 5, 0.002)
    actions = lively_actions(40)
    ours, judged = fly_trainer(config, actions, 20.0), fly_judge(vehicle, actions, 20.0)
    assert np.ptp(judged[0], axis=0).max() > 1.0 and judged[1][..., 2, 2].min() < 0.95
    for one, two in zip(ours, judged, strict=True):
        # Both in double precision; effects are drawn in single, which is what is left.
        np.testing.assert_allclose(one, two, atol=2e-5)


@pytest.mark.parametrize(
    ("rates", "steps", "off_m"),
    [
        pytest.param((100.0, 250.0), (7, 2), 0.02, marks=pytest.mark.slow),
        ((60.0, 120.0), (4, 2), 0.03),
    ],
    ids=["default", "race"],
)
def test_training_steps_stay_near_the_judges(float64, rates, steps, off_m):
    """At 15 Hz: 7 or 4 steps for the judge's 6 or 7 of 10 ms."""
    config = QuadrotorConfig(HIDDEN, *rates, **ALIKE)
    cut = substeps(config, 1 / 15)
    assert cut[:2] == steps and cut.dt == pytest.approx(1 / 15 / np.prod(steps))
    actions = lively_actions(15)
    ours, judged = fly_trainer(config, actions, 15.0), fly_judge(HIDDEN, actions, 15.0)
    assert np.all(np.linalg.norm(judged[0][-1] - [0.0, 0.0, 10.0], axis=-1) > 0.4)
    assert np.linalg.norm(ours[0] - judged[0], axis=-1).max() < off_m
    assert np.linalg.norm(ours[2] - judged[2], axis=-1).max() < 0.1


def test_long_steps_change_a_flight_by_far_less_than_what_is_drawn(float64):
    config = named_recipe("race").quadrotor
    assert config is not None
    # The same actions for all, so that only the vehicles differ.
    actions = np.repeat(lively_actions(30, batch=1), 32, axis=1)

    def off(other):
        """Return how far apart flights end in the median over vehicles [m]."""
        return np.median(np.linalg.norm((other - fine)[-1], axis=-1))

    fine = fly_trainer(replace(config, attitude_hz=100.0, physics_hz=500.0), actions, 30.0)[0]
    long, drawn = fly_trainer(config, actions, 30.0)[0], np.roll(fine, 1, axis=1)
    assert substeps(config, 1 / 30)[:2] == (2, 2)
    assert 0 < off(long) < 0.02 * off(drawn)


OFTEN = "crazyflie21"
"""The lightest of the shipped vehicles, with a loop that remembers; others are slow tests."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n == OFTEN else pytest.mark.slow) for n in shipped_vehicles()],
)
def test_the_default_recipe_draws_vehicles_that_fly(name):
    """Around any shipped vehicle: a second of mild actions tips none over."""
    config = with_quadrotor(named_recipe("race"), load_vehicle(name)).quadrotor
    assert config is not None
    actions = 0.5 * lively_actions(15, batch=64)
    pos_w, rot_w, _ = fly_trainer(config, actions, 15.0)
    assert np.isfinite(pos_w).all() and rot_w[..., 2, 2].min() > 0.5


def test_no_vehicle_is_drawn_lighter_than_the_catalogue_knows():
    config = QuadrotorConfig(PLAIN, mass_std=0.9)
    drawn = quadrotor.draw_effects(config, 200, np.random.default_rng(0))["mass_offset"].offset
    assert drawn.min() == pytest.approx(-0.5 * PLAIN.mass) and np.ptp(drawn) > PLAIN.mass


def test_the_rollouts_gradient_is_that_of_finite_differences(float64, monkeypatch):
    """The whole of a blind policy's loss: no decay, no field, no closing speed, heading held.

    A Delta Action network corrects it, of which the attitude, which turns its velocity, is a part.
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
    rollout = make_rollout(config)

    @jax.jit
    @jax.value_and_grad
    def loss(params):
        embedding_shift = jnp.zeros((5, 2, SPEC.hidden_size))
        blind = lambda p, image: jnp.zeros((2, SPEC.hidden_size))  # noqa: E731
        return rollout(params, embedding_shift, worlds, jax.random.key(5), blind, delta)[0]

    gradient = loss(params)[1]
    rng = np.random.default_rng(0)
    for name in ("state.weight", "gru.weight_hidden", "action.weight"):
        direction = rng.normal(size=params[name].shape)
        ahead, behind = (
            loss({**params, name: params[name] + h * direction})[0] for h in (1e-6, -1e-6)
        )
        slope = float(ahead - behind) / 2e-6
        assert abs(slope) > 1e-4
        assert float((gradient[name] * direction).sum()) == pytest.approx(slope, rel=1e-4)


def test_gradients_of_the_motion_fade_as_those_of_the_point_mass(float64):
    config = QuadrotorConfig(PLAIN, **ALIKE)
    still, keys = jnp.zeros((1, 3)), jax.random.split(jax.random.key(0), 1)
    effects = doubled(quadrotor.draw_effects(config, 1, np.random.default_rng(0)))
    constants = QuadrotorParams(np.full(1, 0.05), effects)

    def end(pos_w, decay):
        start, step = quadrotor_dynamics(config, 0.05, decay)
        body = start(constants, pos_w, still, still + jnp.asarray([1.0, 0.0, 0.0]))

        def one(body, _):
            return step(body, constants, still, still + 5.0, keys), None

        return jax.lax.scan(one, body, length=3)[0].pos_w[0, 0]

    slope = jax.jit(jax.grad(end), static_argnums=1)(still, 0.916)[0, 0]
    assert float(slope) == pytest.approx(np.exp(-0.916 * 0.15), rel=1e-9)


def test_quadrotors_vary_around_the_vehicle_and_the_tracks_stay_the_same():
    point = small_config(batch=64)
    quad = replace(point, quadrotor=QuadrotorConfig(HIDDEN))
    one, two, again = sample_worlds(point, 3), sample_worlds(quad, 3), sample_worlds(quad, 3)
    np.testing.assert_array_equal(one.pos_w, two.pos_w)
    np.testing.assert_array_equal(one.scene.boxes.center_w, two.scene.boxes.center_w)
    assert isinstance(two.constants, quadrotor.QuadrotorParams)
    assert isinstance(again.constants, quadrotor.QuadrotorParams)
    effects = two.constants.effects
    for name, value in effects.items():
        for field, repeated in zip(value, again.constants.effects[name], strict=True):
            np.testing.assert_array_equal(field, repeated)
            assert field.shape[0] == 64 and np.ptp(field, axis=0).min() > 0, name
    assert effects["command_delay"].delay.mean() == pytest.approx(0.037, abs=0.003)
    assert np.all(np.abs(effects["command_delay"].delay - 0.037) <= 0.01 + 1e-6)
    assert effects["motor_lag"].time_constant.mean() == pytest.approx(0.02, rel=0.1)
    np.testing.assert_allclose(effects["rate_gain"].scale.mean(0), [0.6, 0.7, 1.2], rtol=0.05)
    np.testing.assert_allclose(effects["linear_drag"].coefficient.mean(0), [0.3, 0.2, 0.1], atol=0.03)  # noqa: E501  # fmt: skip
    assert np.all(effects["linear_drag"].coefficient >= 0)
    assert "com_offset" not in effects, "what does not vary stays the vehicle's"
    bare = quadrotor.draw_effects(QuadrotorConfig(PLAIN), 8, np.random.default_rng(0))
    assert np.all(bare["motor_lag"].time_constant == 0)
    wide = QuadrotorConfig(PLAIN, lag_spread_s=0.05)
    spread = quadrotor.draw_effects(wide, 200, np.random.default_rng(0))
    lag = spread["motor_lag"].time_constant
    assert lag.min() == 0 and 0.045 < lag.max() <= 0.05, "a share of no lag is none"
    np.testing.assert_array_equal(
        spread["rate_gain"].scale,
        quadrotor.draw_effects(replace(wide, lag_spread_s=0.0), 200, np.random.default_rng(0))[
            "rate_gain"
        ].scale,
        err_msg="the other draws stay what they are",
    )
    assert np.all((bare["command_delay"].delay >= 0) & (bare["command_delay"].delay <= 0.01))


def test_thrust_centre_of_mass_and_trim_vary_where_asked_and_move_no_other_draw():
    own = {
        "com_offset": EFFECTS["com_offset"].values(np.array([0.006, 0.0, 0.001])),
        "thrust_scale": EFFECTS["thrust_scale"].values(np.float64(0.9)),
    }
    vehicle = replace(PLAIN, effects={**PLAIN.effects, **own})
    config = QuadrotorConfig(vehicle)
    wide = replace(config, thrust_spread=0.2, com_std_m=0.004, trim_std=0.02)
    before = quadrotor.draw_effects(config, 500, np.random.default_rng(1))
    after = quadrotor.draw_effects(wide, 500, np.random.default_rng(1))
    assert set(after) - set(before) == {"thrust_scale", "com_offset", "torque_trim"}
    for name, values in before.items():
        np.testing.assert_array_equal(values[0], after[name][0])
    scale, (offset,) = after["thrust_scale"].scale, after["com_offset"]
    assert 0.72 <= scale.min() < 0.75 and 1.05 < scale.max() <= 1.08
    np.testing.assert_allclose(offset.mean(0), [0.006, 0.0, 0.001], atol=6e-4)
    np.testing.assert_allclose(offset.std(0), [0.00384, 0.00384, 0.0], atol=3e-4)
    assert np.abs(offset[:, 1]).max() <= 0.008 + 1e-6
    np.testing.assert_allclose(
        after["torque_trim"].torque.std(0), [0.0192, 0.0192, 0.00384], rtol=0.08
    )


def fly_half_a_second(vehicle):
    """Return where quadrotors of this file alone are, decision after decision."""
    config = QuadrotorConfig(vehicle, **{**ALIKE, "drag_spread": 0.3})
    return fly_trainer(config, lively_actions(7), 15.0)[0]


@pytest.fixture(scope="module")
def flown_plainly():
    return fly_half_a_second(PLAIN)


FLOWN_TOGETHER = (
    "rotor_drag",
    "constant_wind",
    "gusts",
    "ground_effect",
    "command_delay",
    "inertia_scale",
    "frame_tilt",
    "battery_sag",
    "weak_motor",
    "rotor_spin_up",
    "slung_load",
)
"""One of each way in which an effect acts, and several that change the vehicle itself."""


def test_one_of_each_way_in_which_effects_act_is_flown_together():
    def acts(name):
        hooks = (field.name for field in fields(EFFECTS[name]) if field.name != "values")
        return frozenset(hook for hook in hooks if callable(getattr(EFFECTS[name], hook)))

    in_flight = {acts(name) for name, effect in EFFECTS.items() if effect.in_flight}
    assert {acts(name) for name in FLOWN_TOGETHER} == in_flight


def typical(name):
    """Return the effect `name` at a typical strength."""
    still = neutral(EFFECTS[name], PLAIN)
    parameters = EFFECTS[name].parameters
    return EFFECTS[name].values(
        **{p.name: np.asarray(getattr(still, p.name)) + p.typical[1] for p in parameters}
    )


def test_effects_of_every_kind_fly_in_training_together():
    vehicle = replace(PLAIN, effects={name: typical(name) for name in FLOWN_TOGETHER})
    assert np.isfinite(fly_half_a_second(vehicle)).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, effect in EFFECTS.items() if effect.in_flight])
def test_every_effect_of_a_vehicle_file_flies_in_training(name, flown_plainly):
    """A typical strength of it changes where the quadrotor is after half a second."""
    flown = fly_half_a_second(replace(PLAIN, effects={name: typical(name)}))
    assert np.isfinite(flown).all()
    if name != "ground_effect":  # too high above the ground
        assert np.abs(flown_plainly - flown).max() > 1e-5

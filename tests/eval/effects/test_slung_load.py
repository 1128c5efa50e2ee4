"""A load on a line: its weight, its period, momentum and energy, slack, and steps of any length."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.effects import slung_load
from eval.effects.interface import GRAVITY
from eval.effects.slung_load import LoadState, SlungLoad
from eval.quadrotor.plant import Command, Motion, make_plant
from eval.quadrotor.stepper import Inputs, hover_state, plant_step, rollout, step
from tests.support.vehicles import PLAIN, at_rest, with_effects, with_lag

LOAD, LENGTH = 0.05, 0.5

LOADED = with_effects(slung_load=(LOAD, LENGTH))

TOTAL = PLAIN.mass + LOAD

# What carries both in hover, as the controller counts it: per mass of the vehicle alone.
HOLDING = Inputs(Command(np.asarray(GRAVITY * TOTAL / PLAIN.mass), np.zeros(3)))

FALLING = Inputs(rotor_speed=np.zeros(4))


def hanging(plant, line_w=None, vel_w=(0.0, 0.0, 0.0)):
    """Return the plant's state in hover, its load at `line_w` from the vehicle if that is given."""
    state = hover_state(plant, ())
    swing = state.carried["slung_load"]
    line_w = swing.line_w if line_w is None else np.asarray(line_w)
    return state._replace(carried={"slung_load": LoadState(line_w, np.asarray(vel_w))})


def flown(plant, state, motion, inputs, duration_s):
    """Yield state, motion and wrench after each step."""
    for k in range(round(duration_s / float(plant.dt))):
        now = inputs if isinstance(inputs, Inputs) else inputs(k * plant.dt)
        state, motion, wrench = step(plant, state, motion, now, k * plant.dt)
        yield state.carried["slung_load"], motion, wrench, state


def lively(time_s):
    """Return a command with hard turns; what it asks of the rotors is within their limits."""
    rate_b = 3.0 * np.sin(np.array([5.0, 4.0, 3.0]) * time_s)
    return Inputs(Command(np.asarray(12.0 + 4.0 * np.sin(7.0 * time_s)), rate_b))


def test_a_step_of_the_line_is_backward_euler_of_a_damped_spring():
    """The tension is that of the stretch and its speed at the end of the step, however long."""
    at_m, speed, dt = 0.01, 0.3, 0.02
    flow: Any = SimpleNamespace(
        memory=LoadState(np.array([0.0, 0.0, -LENGTH - at_m]), np.array([0.0, 0.0, -speed])), dt=dt
    )
    values = SlungLoad(np.asarray(LOAD), np.asarray(LENGTH))
    parting = float(slung_load._tension(values, flow)[1][0])
    after = speed - dt * parting
    spring = slung_load.STIFFNESS**2 * (at_m + dt * after)
    damper = 2.0 * slung_load.DAMPING * slung_load.STIFFNESS * after
    assert parting == pytest.approx(spring + damper) and parting > 1.0


@pytest.mark.parametrize("dt", [0.002, 0.004, 0.02])
def test_a_hanging_load_pulls_by_its_weight_and_both_hover(dt):
    plant = make_plant(LOADED, dt)
    for swing, motion, wrench, _ in flown(plant, hanging(plant), at_rest(), HOLDING, 0.6):
        # The rotors hold both, and the line takes the load's weight of 0.4905 N off them again.
        np.testing.assert_allclose(wrench.force_b, [0, 0, 0.75 * 9.81], atol=1e-9)
        np.testing.assert_allclose(motion.pos_w, [0, 0, 1], atol=1e-9)
        assert 0.0 < -swing.line_w[2] - LENGTH < (0.002 if dt < 0.005 else 0.01)


def test_the_start_is_where_a_swing_comes_to_rest():
    plant = make_plant(LOADED, 0.002)
    start = hover_state(plant, (2,)).carried["slung_load"]
    *_, (swing, *_) = flown(plant, hanging(plant, [0, 0, -0.49]), at_rest(), HOLDING, 1.0)
    np.testing.assert_allclose(swing.line_w, start.line_w[0], atol=1e-6)
    # Along gravity, where that leans.
    leaning = with_effects(slung_load=(LOAD, LENGTH), frame_tilt=((0.0, 0.1),))
    line_w = hover_state(make_plant(leaning, 0.002), ()).carried["slung_load"].line_w
    assert line_w[0] / line_w[2] == pytest.approx(np.tan(0.1))


def test_small_swings_have_the_period_of_both_masses():
    """Level under (M + m) g the vehicle is free to give way: 2 pi sqrt(L / (g (1 + m / M)))."""
    plant = make_plant(LOADED, 0.002)
    hangs = hanging(plant).carried["slung_load"].line_w
    state = hanging(plant, hangs + [0.01, 0.0, 0.0])
    offset = [swing.line_w[0] for swing, *_ in flown(plant, state, at_rest(), HOLDING, 3.2)]
    offset = np.array(offset)
    down = np.flatnonzero((offset[:-1] > 0.0) & (offset[1:] <= 0.0))
    crossed = down + offset[down] / (offset[down] - offset[down + 1])
    period = 2 * np.pi * np.sqrt(-hangs[2] / (GRAVITY * (1 + LOAD / PLAIN.mass)))
    np.testing.assert_allclose(np.diff(crossed) * 0.002, period, rtol=1e-3)


def test_momentum_changes_by_gravity_and_rotors_alone():
    vehicle = with_lag(LOADED, 0.03)
    loaded, bare = make_plant(vehicle, 0.002), make_plant(with_lag(PLAIN, 0.03), 0.002)
    state, motion = hanging(loaded, [0.3, 0.1, -0.4], [0.5, -1.0, 0.0]), at_rest()

    def momentum(state, motion):
        return TOTAL * motion.vel_w + LOAD * state.carried["slung_load"].vel_w

    for k in range(250):
        before, inputs = momentum(state, motion), lively(0.002 * k)
        _, rotors = plant_step(bare, state._replace(carried={}), motion, inputs, 0.002 * k)
        force_w = motion.rot_w @ rotors.force_b + [0.0, 0.0, -9.81 * TOTAL]
        state, motion, _ = step(loaded, state, motion, inputs, 0.002 * k)
        np.testing.assert_allclose(momentum(state, motion) - before, 0.002 * force_w, atol=1e-12)


def test_a_wide_swing_keeps_its_energy_but_for_what_the_line_takes():
    plant = make_plant(LOADED, 0.002)
    angle = 1.0
    start = (LENGTH + 0.001) * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    heights = []
    for swing, *_ in flown(plant, hanging(plant, start), at_rest(), HOLDING, 4.0):
        # Seen from the vehicle, whose weight the rotors' push makes up for, the load falls by it.
        push = GRAVITY * TOTAL / PLAIN.mass
        heights.append((0.5 * swing.vel_w @ swing.vel_w + push * swing.line_w[2]) / push)
    heights = np.array(heights) - heights[0]
    assert heights.max() < 0.001, "m, of 0.23 m"
    assert -0.006 < heights[-1] < 0.0


def test_a_slack_line_pulls_nothing():
    plant = make_plant(LOADED, 0.002)
    state = hanging(plant, [0.0, 0.0, -0.4])._replace(rotor_speed=np.zeros(4))
    rows = list(flown(plant, state, at_rest(), FALLING, 0.5))
    for swing, _, wrench, _ in rows:
        assert not wrench.force_b.any(), "both fall freely"
        np.testing.assert_allclose(swing.line_w, [0.0, 0.0, -0.4], atol=1e-12)
    np.testing.assert_allclose(rows[-1][1].vel_w[2], -9.81 * 0.5)
    # A load that is thrown up hangs loose until it has fallen back and 0.1 m below: 0.143 s.
    hover = Inputs(Command(np.asarray(GRAVITY), np.zeros(3)))
    pulls = [
        wrench.force_b[2] - 0.75 * 9.81
        for _, _, wrench, _ in flown(plant, hanging(plant, [0, 0, -0.4]), at_rest(), hover, 0.2)
    ]
    first = np.flatnonzero(np.abs(pulls) > 1e-9)[0] * 0.002
    assert first == pytest.approx(np.sqrt(2 * 0.1 / 9.81), abs=0.004)
    assert min(pulls) < -0.5 and max(pulls) < 1e-9, "it pulls down and never pushes up"


@pytest.mark.parametrize("mass", [0.0, LOAD])
@pytest.mark.parametrize("line_w", [(0.0, 0.0, 0.0), (0.0, 0.0, -0.5), (0.1, 0.0, -0.2)])
def test_gradients_are_finite_wherever_the_load_is(mass, line_w):
    steps = 20
    inputs = Inputs(Command(jnp.full(steps, 12.0), jnp.full((steps, 3), 0.5)))
    start = Motion(*map(jnp.asarray, at_rest()))

    def end(values, line_w, vel_w):
        plant = make_plant(PLAIN, 0.004, {"slung_load": values})
        state = hover_state(plant, (), jnp)._replace(
            carried={"slung_load": LoadState(line_w, vel_w)}
        )
        return rollout(plant, start, inputs, state).motion.pos_w.sum()

    values = SlungLoad(jnp.asarray(mass), jnp.asarray(LENGTH))
    slopes = jax.jit(jax.grad(end, (0, 1, 2)))(
        values, jnp.asarray(line_w), jnp.asarray([0.3, 0.2, -0.4])
    )
    leaves = jax.tree.leaves(slopes)
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    if mass and line_w[2] < -0.4:
        assert all(np.abs(leaf).max() > 1e-6 for leaf in leaves)


def held(time_s):
    """Return `lively` commands that hold for 20 ms, the same for steps of any length."""
    return lively(0.02 * np.floor(time_s / 0.02 + 1e-6))


def test_steps_converge_and_none_is_too_long():
    def end(dt):
        plant = make_plant(with_lag(LOADED, 0.03), dt)
        state = hanging(plant, [0.2, 0.1, -0.45])
        *_, (swing, motion, *_) = flown(plant, state, at_rest(), held, 0.6)
        return np.concatenate([motion.pos_w, motion.pos_w + swing.line_w])

    exact = end(0.00025)
    errors = {dt: np.abs(end(dt) - exact).max() for dt in (0.001, 0.002, 0.004, 0.02)}
    assert errors[0.001] < errors[0.002] < errors[0.004] < 0.05
    # Of order 1, against a step of a quarter of the finest.
    assert errors[0.001] < 0.35 * errors[0.004]
    assert errors[0.02] < 0.5, errors

"""Rate loops of firmwares: filters and motors by hand, the same flight in numpy, JAX and MuJoCo."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.quadrotor import loops
from eval.quadrotor.loops.filters import Pair, butterworth, layout_of, pt1, settled
from eval.quadrotor.plant import Command, Motion, make_plant
from eval.quadrotor.stepper import Inputs, hover_state, rollout, step
from eval.quadrotor.vehicle_file import load_vehicle, parse_vehicle, vehicle_table

DT = 1.0 / 500.0


def vehicle(kind):
    """Return the reference quadrotor without effects, with the rate loop of a firmware."""
    nominal = load_vehicle("reference")
    controller = replace(
        nominal.controller, kind=kind, settings=loops.KINDS[kind].Settings(), rate_gain=(1.0,) * 3
    )
    return replace(nominal, controller=controller, effects={})


def inputs(count, rate_b):
    """Return commands: a step of the body rates after 0.1 s, at hover thrust."""
    late = np.arange(count) * DT > 0.1
    rate = np.where(late[:, None], np.asarray(rate_b), 0.0)
    return Inputs(command=Command(np.full(count, 9.81), rate))


def still():
    return Motion(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3))


@pytest.mark.parametrize("kind", loops.KINDS)
def test_numpy_and_jax_fly_the_same_and_follow_the_rates(kind):
    plant = make_plant(vehicle(kind), DT)
    given = inputs(160, [1.0, -0.7, 0.4])
    state, motion, rates = hover_state(plant, ()), still(), []
    for k in range(160):
        now = jax.tree.map(lambda value, k=k: value[k], given)
        state, motion, _ = step(plant, state, motion, now, k * DT)
        rates.append(motion.rate_b)
    flown = jax.jit(rollout)(plant, still(), given)
    np.testing.assert_allclose(flown.motion.rate_b[1:], np.array(rates), atol=2e-3)
    np.testing.assert_allclose(rates[-1][:2], [1.0, -0.7], atol=0.3)
    assert rates[-1][2] > 0.05
    assert np.abs(rates[48]).max() < 1e-9


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=pytest.mark.slow if kind in ("betaflight", "px4") else ())
        for kind in loops.KINDS
    ],
)
def test_a_batch_flies_as_each_alone_and_has_gradients(kind):
    plant = make_plant(vehicle(kind), DT)
    given = inputs(60, [1.0, 0.0, 0.0])
    motion = jax.tree.map(lambda v: np.stack([v, v]), still())
    motion = motion._replace(rate_b=np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]))
    both = jax.tree.map(lambda v: np.stack([v, v], axis=1), given)
    flown = jax.jit(rollout)(plant, motion, both)

    def last(rate_x):
        start = still()._replace(rate_b=jnp.array([rate_x, 0.0, 0.0]))
        rate_b = rollout(plant, start, given).motion.rate_b
        return rate_b[-1, 0], rate_b

    (_, alone), slope = jax.jit(jax.value_and_grad(last, has_aux=True))(0.5)
    np.testing.assert_allclose(flown.motion.rate_b[:, 1], alone, atol=1e-5)
    assert np.isfinite(slope)


@pytest.mark.parametrize("kind", loops.KINDS)
def test_settings_come_back_from_a_file_and_wrong_ones_are_refused(kind):
    table = vehicle_table(vehicle(kind))
    assert parse_vehicle(table).controller == vehicle(kind).controller
    group = loops.KINDS[kind].GROUP
    wrong = {**table["controller"]}
    if group:
        wrong[group] = {**wrong[group], "roll_kpp": 1.0}
    else:
        wrong["p_rol"] = 1.0
    with pytest.raises(ValueError, match="is unknown"):
        parse_vehicle({**table, "controller": wrong})
    with pytest.raises(ValueError, match="controller.kind"):
        parse_vehicle({**table, "controller": {**table["controller"], "kind": "ardupilot"}})


def test_the_nominal_loop_has_no_memory():
    plant = make_plant(load_vehicle("reference"), DT)
    assert plant.loop is None
    assert hover_state(plant, (3,)).loop == ()
    assert "kind" not in vehicle_table(load_vehicle("reference"))["controller"]


def test_rate_gain_scales_the_whole_loop():
    table = vehicle_table(vehicle("px4"))
    table["effects"] = {"rate_gain": {"scale": [0.5, 1.0, 1.0]}}
    weak = make_plant(parse_vehicle(table), DT)
    full = make_plant(vehicle("px4"), DT)
    given = inputs(56, [1.0, 1.0, 0.0])
    fly = jax.jit(rollout)
    slow, fast = (fly(plant, still(), given).motion.rate_b[-1] for plant in (weak, full))
    np.testing.assert_allclose(slow[0], 0.5 * fast[0], rtol=0.1)
    np.testing.assert_allclose(slow[1], fast[1], rtol=0.01)


def test_first_order_by_hand():
    """2 pi 100 0.002 = 1.256637; k = 1.256637 / 2.256637 = 0.556862."""
    out = pt1(np.array([1.0]), np.array([3.0]), np.asarray(100.0), 0.002)
    np.testing.assert_allclose(out, 1.0 + 2.0 * 0.556862, atol=2e-6)
    np.testing.assert_allclose(pt1(np.array([1.0]), np.array([3.0]), np.asarray(0.0), 0.002), 3.0)


@pytest.mark.parametrize(("hz", "gain"), [(0.01, 1.0), (30.0, 2.0**-0.5), (240.0, 0.01)])
def test_second_order_has_half_the_power_at_its_cutoff(hz, gain):
    memory, out, dt = Pair(np.zeros(1), np.zeros(1)), [], 0.002
    time = np.arange(0, 1 if hz > 1 else 30, dt)
    wave = np.sin(2 * np.pi * hz * time)
    for value in wave:
        memory, y = butterworth(memory, np.array([value]), np.asarray(30.0), dt)
        out.append(y[0])
    half = len(out) // 2
    ratio = np.std(out[half:]) / np.std(wave[half:])
    assert abs(ratio - gain) < 0.02


def test_a_settled_filter_stays_where_it_is():
    rest = settled(np.array([2.0]), np.asarray(30.0), 0.002)
    memory, out = butterworth(rest, np.array([2.0]), np.asarray(30.0), 0.002)
    np.testing.assert_allclose(out, 2.0)
    np.testing.assert_allclose(memory.first, rest.first)


def test_left_motors_roll_right_rear_ones_pitch_down_clockwise_ones_yaw_left():
    roll, pitch, yaw = layout_of(load_vehicle("crazyflie21").rotors)
    np.testing.assert_allclose(roll, [-1, -1, 1, 1])
    np.testing.assert_allclose(pitch, [-1, 1, 1, -1])
    np.testing.assert_allclose(yaw, [-1, 1, -1, 1])

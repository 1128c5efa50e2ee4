"""What all effects have in common: neutral values, numpy and JAX alike, faults of logs undone."""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.effects import EFFECTS, all_values
from eval.effects.body import MASS_OFFSET as MASS
from eval.effects.interface import Effect, Parameter, Sample, along_z, as_arrays
from eval.effects.log_faults import apply_log_faults, pose_delay, time_shifted, to_logged, to_true
from eval.effects.slung_load import SlungLoad
from eval.quadrotor.plant import Command, Motion, Wrench, make_plant
from eval.quadrotor.stepper import Inputs, hover_state, plant_step
from tests.support.faults import ImuFault, with_imu_fault
from tests.support.flights import small_log
from tests.support.vehicles import PLAIN, drawn_effects
from tracks.geometry.rotation import exp_rot, quat_to_rot

# All four rotors at 1000 rad/s push 1.6 N each; their torques about z cancel.
SPEED = np.full(4, 1000.0)

MOVING = Motion(np.zeros(3), np.eye(3), np.array([3.0, -2.0, 1.0]), np.array([1.0, 2.0, -0.5]))


def test_neutral_values_change_nothing():
    vehicle = replace(PLAIN, rotors=replace(PLAIN.rotors, time_constant=0.02))
    plain, full = make_plant(vehicle, 0.002), make_plant(vehicle, 0.002, all_values(vehicle), 0.02)
    states = [hover_state(plant, ()) for plant in (plain, full)]
    for k in range(10):
        command = Command(np.array(9.0 + k), np.array([1.0, 0.1 * k, -1.0]))
        acting = []
        for i, plant in enumerate((plain, full)):
            states[i], one = plant_step(plant, states[i], MOVING, Inputs(command), 3.0)
            acting.append(np.concatenate(one))
        np.testing.assert_allclose(acting[1], acting[0], rtol=1e-12, atol=1e-15)


def test_numpy_and_jax_agree_on_the_whole_catalogue():
    rng = np.random.default_rng(5)
    vehicle = drawn_effects(rng, replace(PLAIN, rotors=replace(PLAIN.rotors, time_constant=0.03)))
    n = 7
    rot = np.linalg.qr(rng.standard_normal((n, 3, 3)))[0]
    rot *= np.sign(np.linalg.det(rot))[:, None, None]
    motion = Motion(
        rng.uniform(0.05, 2.0, (n, 3)), rot, 5 * rng.standard_normal((n, 3)),
        2 * rng.standard_normal((n, 3)),
    )  # fmt: skip
    plant = make_plant(vehicle, 0.002)
    commands = rng.uniform(0.0, 25.0, (12, n)), 4 * rng.standard_normal((12, n, 3))
    noise = rng.standard_normal((12, n, 3))

    def fly(xp):
        now = Motion(*(xp.asarray(field) for field in motion))
        state, acting = hover_state(plant, (n,), xp, xp.asarray(noise[0])), Wrench(now, now)
        for k in range(12):
            command = Command(xp.asarray(commands[0][k]), xp.asarray(commands[1][k]))
            inputs = Inputs(command, noise=xp.asarray(noise[k]))
            state, acting = plant_step(plant, state, now, inputs, 0.5 + 0.002 * k)
        return acting, state

    with jax.enable_x64(True):
        ours, theirs = fly(np), jax.jit(lambda: fly(jnp))()
        assert isinstance(ours[0].force_b, np.ndarray)
        for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-12)


def test_parameters_with_a_batch_axis_are_one_vehicle_each():
    rng = np.random.default_rng(6)
    drawn = [drawn_effects(rng) for _ in range(3)]
    stacked = jax.tree.map(
        lambda *leaves: np.stack(leaves), *(all_values(vehicle) for vehicle in drawn)
    )
    together = make_plant(PLAIN, 0.002, stacked, max_delay=0.04)
    motion = Motion(*(np.stack([field] * 3) for field in MOVING))
    inputs = Inputs(Command(np.full(3, 12.0), np.tile([1.0, -1.0, 0.2], (3, 1))))
    state, acting = hover_state(together, (3,)), Wrench(None, None)
    for k in range(25):
        state, acting = plant_step(together, state, motion, inputs, np.full(3, 0.1 * k))
    for i, vehicle in enumerate(drawn):
        alone = make_plant(vehicle, 0.002, max_delay=0.04)
        own, one = hover_state(alone, ()), Wrench(None, None)
        for k in range(25):
            row = jax.tree.map(lambda x, i=i: x[i], inputs)
            own, one = plant_step(alone, own, MOVING, row, 0.1 * k)
        np.testing.assert_allclose(acting.force_b[i], one.force_b, rtol=1e-10)
        np.testing.assert_allclose(acting.torque_b[i], one.torque_b, rtol=1e-9, atol=1e-12)


class Flywheel(NamedTuple):
    """Values of an effect of another package."""

    push: Any


WHEEL = Effect(
    name="flywheel",
    summary="A push that grows with the way that the vehicle was accelerated up",
    equation="tau_b += push s e3, ds/dt = dv_z/dt",
    source="test",
    values=Flywheel,
    parameters=(Parameter("push", "N m s/m", 0.0, 0.0, 1.0, (0.1, 0.2)),),
    start=lambda values, flow: {"speed": flow.pos_w[..., 2]},
    torque=lambda values, flow: along_z(values.push * flow.memory["speed"]),
    carry=lambda values, flow, acc_w: {"speed": flow.memory["speed"] + flow.dt * acc_w[..., 2]},
)


@pytest.mark.parametrize("xp", [np, jnp])
def test_an_effect_of_another_package_may_have_a_motion_of_its_own(monkeypatch, xp):
    monkeypatch.setitem(EFFECTS._entries, WHEEL.name, WHEEL)
    monkeypatch.setitem(EFFECTS._values, WHEEL.name, WHEEL)
    plant = make_plant(PLAIN, 0.002, {"flywheel": Flywheel(0.5), "slung_load": SlungLoad(0.1, 0.5)})
    state, motion = (
        hover_state(plant, (2,), xp),
        Motion(*(xp.stack([xp.asarray(f)] * 2) for f in MOVING)),
    )
    inputs = Inputs(rotor_speed=xp.full((2, 4), 1000.0))
    step = plant_step if xp is np else jax.jit(plant_step)
    for _ in range(3):
        state, wrench = step(plant, state, motion, inputs, 0.0)
    # Four rotors push 6.4 N; a load of 0.981 N hangs on 0.75 kg. Two steps went before.
    gained = 0.004 * ((6.4 - 0.981) / 0.75 - 9.81)
    np.testing.assert_allclose(wrench.torque_b, [[0.0, 0.0, 0.5 * gained]] * 2, rtol=0.05)
    assert set(state.carried) == {"flywheel", "slung_load"}
    assert not WHEEL.nameable and not WHEEL.by_state, "no stretch of a flight can begin with it"
    with pytest.raises(ValueError, match="effects.* motion of its own.*leave it out"):
        plant_step(plant, state._replace(carried={}), motion, inputs, 0.0)


@pytest.mark.parametrize("values", [NamedTuple("Other", [("shove", Any)]), tuple])
def test_values_have_a_field_for_each_parameter(values):
    with pytest.raises(ValueError, match=r"parameters the names \['push'\]; both must be the same"):
        EFFECTS.register("flywheel", replace(WHEEL, values=values))


def test_usual_directions_are_unit_vectors():
    for effect in EFFECTS.values():
        for parameter in effect.parameters:
            assert np.linalg.norm(parameter.direction or (1.0,)) == pytest.approx(1.0)


def test_a_memory_needs_both_of_its_hooks():
    half = replace(WHEEL, carry=None)
    with pytest.raises(ValueError, match="only one of `start` and `carry`"):
        EFFECTS.register("flywheel", half)


FAULT = ImuFault((0.0, 0.0, 0.2), 1.1, 0.01)


def a_sample(rng, n=5):
    rot_w = exp_rot(rng.standard_normal((n, 3)))
    pos_w, vel_w, rate_b, acc_b = rng.standard_normal((4, n, 3))
    return Sample(pos_w, rot_w, vel_w, rate_b, acc_b)


def test_a_shifted_series_goes_on_beyond_its_ends_as_it_began_and_ended():
    time_s, series = np.array([0.0, 1.0, 2.0, 4.0]), np.array([[0.0], [1.0], [5.0], [1.0]])
    for offset, wanted in ((0.5, [-0.5, 0.5, 3.0, 2.0]), (-0.5, [0.5, 3.0, 4.0, 0.0])):
        np.testing.assert_allclose(time_shifted(time_s, series, np.asarray(offset))[:, 0], wanted)


def test_the_catalogue_undoes_its_own_faults_on_a_sample():
    rng = np.random.default_rng(2)
    drawn = {n: as_arrays(v) for n, v in drawn_effects(rng, PLAIN).effects.items()}
    sample = a_sample(rng)
    seen = to_logged(drawn, sample)
    np.testing.assert_array_equal(seen.rate_b, sample.rate_b + drawn["gyro_bias"].bias)
    np.testing.assert_array_equal(seen.acc_b, sample.acc_b + drawn["accelerometer_bias"].bias)
    assert pose_delay(drawn) == drawn["clock_offset"].offset
    for one, other in zip(to_true(drawn, seen), sample, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    assert pose_delay({}) == 0.0 and to_logged({}, sample) is sample


@pytest.mark.parametrize("xp", [np, jnp])
def test_a_fault_of_another_package_acts_on_a_log(monkeypatch, xp):
    """It turns the frame, scales a channel and reads poses late, from one hook each."""
    with_imu_fault(monkeypatch)
    log = {name: xp.asarray(values) for name, values in small_log().items()}
    faulted = partial(apply_log_faults, {"imu_fault": FAULT})
    faulty = (faulted if xp is np else jax.jit(faulted))(log)
    np.testing.assert_allclose(faulty["rate_b"], 1.1 * log["rate_b"], rtol=1e-6)  # about z alone
    np.testing.assert_allclose(faulty["pos_w"][:, 0], 3.0 * (log["time_s"] - 0.01), atol=1e-6)
    heading = np.asarray(small_log()["time_s"]) - 0.01 + 0.2
    rot_w = np.asarray(quat_to_rot(faulty["quat_wxyz"]))
    np.testing.assert_allclose(np.arctan2(rot_w[:, 1, 0], rot_w[:, 0, 0]), heading, atol=1e-5)
    np.testing.assert_array_equal(faulty["thrust_cmd"], log["thrust_cmd"])


def test_a_small_fault_of_another_package_is_undone(monkeypatch):
    with_imu_fault(monkeypatch)
    sample = a_sample(np.random.default_rng(3))
    fault = {"imu_fault": as_arrays(ImuFault((1e-4, -2e-4, 3e-4), 1.0002, 0.0))}
    seen = to_logged(fault, sample)
    assert np.abs(seen.rate_b - sample.rate_b).max() > 1e-4
    for one, other in zip(to_true(fault, seen), sample, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_what_is_added_must_be_an_effect_of_its_name():
    with pytest.raises(ValueError, match="'heavier'.*'mass_offset'.*the same"):
        EFFECTS.register("heavier", MASS)
    with pytest.raises(ValueError, match="must be an eval.effects.interface.Effect"):
        EFFECTS.register("heavier", cast(Effect, "heavier"))
    by_vehicle = Parameter("x", "1", lambda vehicle: vehicle.mass, 0.0, 1.0, (0.1, 0.2))
    fault = Effect("odd", "", "", "", tuple, (by_vehicle,), late=lambda values: values.x)
    with pytest.raises(ValueError, match="must be numbers"):
        EFFECTS.register("odd", fault)
    assert "odd" not in EFFECTS

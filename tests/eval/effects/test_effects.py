"""What all effects have in common, faults of logs undone, and the physics of a load on a line."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.effects import EFFECTS, all_values, slung_load
from eval.effects.body import MASS_OFFSET as MASS
from eval.effects.interface import GRAVITY, Effect, Parameter, Sample, along_z, as_arrays
from eval.effects.log_faults import pose_delay, time_shifted, to_logged, to_true
from eval.effects.slung_load import LoadState, SlungLoad
from eval.quadrotor.plant import Command, Motion, Wrench, make_plant
from eval.quadrotor.stepper import Inputs, hover_state, plant_step, rollout, step
from tests.support.faults import ImuFault, with_imu_fault
from tests.support.marks import more
from tests.support.vehicles import PLAIN, at_rest, drawn_effects, with_effects, with_lag
from tracks.geometry.rotation import exp_rot

MOVING = Motion(np.zeros(3), np.eye(3), np.array([3.0, -2.0, 1.0]), np.array([1.0, 2.0, -0.5]))


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
    state = jax.tree.map(xp.asarray, hover_state(plant, (2,)))
    motion = Motion(*(xp.stack([xp.asarray(f)] * 2) for f in MOVING))
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
        step(plant, state._replace(carried={}), motion, inputs, 0.0)


def test_a_series_is_shifted_by_a_cubic_between_rows_and_goes_on_as_a_line_beyond_its_ends():
    time_s = np.array([0.0, 1.0, 2.5, 4.0, 4.5])

    def cubic(at_s):
        return (0.5 - 2.0 * at_s + at_s**2 - 0.3 * at_s**3)[:, None]

    for offset, known in ((0.5, slice(1, None)), (-0.5, slice(None, -1)), (0.0, slice(None))):
        shifted = time_shifted(time_s, cubic(time_s), np.asarray(offset))
        np.testing.assert_allclose(shifted[known], cubic(time_s - offset)[known], atol=1e-9)
    # At rest, and then moving: before the start it has always been at rest.
    moving = np.array([[1.0], [1.0], [1.0], [5.0], [9.0]])
    assert time_shifted(time_s, moving, np.asarray(3.0))[0, 0] == 1.0
    assert time_shifted(time_s, moving, np.asarray(-1.0))[-1, 0] == 17.0
    line = time_shifted(np.array([0.0, 2.0]), np.array([[1.0], [2.0]]), np.asarray(1.0))
    np.testing.assert_allclose(line, [[0.5], [1.5]])


def test_faults_of_a_log_are_undone_on_a_sample(monkeypatch):
    rng = np.random.default_rng(2)
    drawn = {n: as_arrays(v) for n, v in drawn_effects(rng, PLAIN).effects.items()}
    pos_w, vel_w, rate_b, acc_b = rng.standard_normal((4, 5, 3))
    sample = Sample(pos_w, exp_rot(rng.standard_normal((5, 3))), vel_w, rate_b, acc_b)
    seen = to_logged(drawn, sample)
    np.testing.assert_array_equal(seen.rate_b, sample.rate_b + drawn["gyro_bias"].bias)
    np.testing.assert_array_equal(seen.acc_b, sample.acc_b + drawn["accelerometer_bias"].bias)
    assert pose_delay(drawn) == drawn["clock_offset"].offset
    for one, other in zip(to_true(drawn, seen), sample, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    # A turn of the frame is undone to first order.
    with_imu_fault(monkeypatch)
    fault = {"imu_fault": as_arrays(ImuFault((1e-4, -2e-4, 3e-4), 1.0002, 0.0))}
    seen = to_logged(fault, sample)
    assert np.abs(seen.rate_b - sample.rate_b).max() > 1e-4
    for one, other in zip(to_true(fault, seen), sample, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)
    assert pose_delay({}) == 0.0 and to_logged({}, sample) is sample


BY_VEHICLE = Parameter("x", "1", lambda vehicle: vehicle.mass, 0.0, 1.0, (0.1, 0.2))
LATE = Effect("odd", "", "", "", tuple, (BY_VEHICLE,), late=lambda values: values.x)


@pytest.mark.parametrize(
    ("name", "effect", "reason"),
    [
        ("flywheel", replace(WHEEL, carry=None), "only one of `start` and `carry`"),
        ("flywheel", replace(WHEEL, values=tuple), r"names \['push'\]; both must be the same"),
        ("heavier", MASS, "'heavier'.*'mass_offset'.*the same"),
        ("a fin", replace(MASS, name="a fin"), "allowed are letters without accents, digits, _"),
        ("fin", replace(MASS, name="fin", needs=("acc",)), r"\['acc'\]; allowed .* acc_b, command"),
        ("fin", replace(MASS, name="fin", needs=cast(Any, "command")), "allowed is a tuple of"),
        ("heavier", cast(Effect, "heavier"), "must be an eval.effects.interface.Effect"),
        ("odd", LATE, "must be numbers"),
    ],
)
def test_what_is_no_effect_of_its_name_is_refused(name, effect, reason):
    with pytest.raises(ValueError, match=reason):
        EFFECTS.register(name, effect)
    assert name not in EFFECTS


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
    line = LoadState(np.array([0.0, 0.0, -LENGTH - at_m]), np.array([0.0, 0.0, -speed]))
    flow: Any = SimpleNamespace(memory=line, dt=dt)
    values = SlungLoad(np.asarray(LOAD), np.asarray(LENGTH))
    parting = float(slung_load._tension(values, flow)[1][0])
    after = speed - dt * parting
    spring = slung_load.STIFFNESS**2 * (at_m + dt * after)
    damper = 2.0 * slung_load.DAMPING * slung_load.STIFFNESS * after
    assert parting == pytest.approx(spring + damper) and parting > 1.0


@pytest.mark.parametrize("dt", [0.002, more(0.004), 0.02])
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


@pytest.mark.extended
def test_small_swings_have_the_period_of_both_masses():
    """Level under (M + m) g the vehicle is free to give way: 2 pi sqrt(L / (g (1 + m / M)))."""
    plant = make_plant(LOADED, 0.002)
    hangs = hanging(plant).carried["slung_load"].line_w
    state = hanging(plant, hangs + [0.01, 0.0, 0.0])
    swings = flown(plant, state, at_rest(), HOLDING, 3.2)
    offset = np.array([swing.line_w[0] for swing, *_ in swings])
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
    for swing, *_ in flown(plant, hanging(plant, start), at_rest(), HOLDING, 2.0):
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
    rows = flown(plant, hanging(plant, [0, 0, -0.4]), at_rest(), hover, 0.2)
    pulls = [wrench.force_b[2] - 0.75 * 9.81 for _, _, wrench, _ in rows]
    first = np.flatnonzero(np.abs(pulls) > 1e-9)[0] * 0.002
    assert first == pytest.approx(np.sqrt(2 * 0.1 / 9.81), abs=0.004)
    assert min(pulls) < -0.5 and max(pulls) < 1e-9, "it pulls down and never pushes up"


def test_gradients_are_finite_wherever_the_load_is():
    steps = 20
    inputs = Inputs(Command(jnp.full(steps, 12.0), jnp.full((steps, 3), 0.5)))
    start = Motion(*map(jnp.asarray, at_rest()))

    def end(values, line_w, vel_w):
        plant = make_plant(PLAIN, 0.004, {"slung_load": values})
        carried = {"slung_load": LoadState(line_w, vel_w)}
        state = hover_state(plant, (), jnp)._replace(carried=carried)
        return rollout(plant, start, inputs, state).motion.pos_w.sum()

    slopes, vel_w = jax.jit(jax.grad(end, (0, 1, 2))), jnp.asarray([0.3, 0.2, -0.4])
    for mass in (0.0, LOAD):
        for line_w in ((0.0, 0.0, 0.0), (0.0, 0.0, -0.5), (0.1, 0.0, -0.2)):
            values = SlungLoad(jnp.asarray(mass), jnp.asarray(LENGTH))
            leaves = jax.tree.leaves(slopes(values, jnp.asarray(line_w), vel_w))
            assert all(np.isfinite(leaf).all() for leaf in leaves), (mass, line_w)
            if mass and line_w[2] < -0.4:
                assert all(np.abs(leaf).max() > 1e-6 for leaf in leaves)


def held(time_s):
    """Return `lively` commands that hold for 20 ms, the same for steps of any length."""
    return lively(0.02 * np.floor(time_s / 0.02 + 1e-6))


@pytest.mark.extended
def test_steps_converge_and_none_is_too_long():
    def end(dt):
        plant = make_plant(with_lag(LOADED, 0.03), dt)
        state = hanging(plant, [0.2, 0.1, -0.45])
        *_, (swing, motion, *_) = flown(plant, state, at_rest(), held, 0.4)
        return np.concatenate([motion.pos_w, motion.pos_w + swing.line_w])

    exact = end(0.00025)
    errors = {dt: np.abs(end(dt) - exact).max() for dt in (0.001, 0.002, 0.004, 0.02)}
    assert errors[0.001] < errors[0.002] < errors[0.004] < 0.05
    # Of order 1, against a step of a quarter of the finest.
    assert errors[0.001] < 0.35 * errors[0.004]
    assert errors[0.02] < 0.5, errors

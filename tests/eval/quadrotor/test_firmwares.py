"""Rate loops of firmwares: by hand, from a file, and the same flight in numpy and JAX."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from eval.quadrotor import loops
from eval.quadrotor.loops import betaflight, crazyflie, px4
from eval.quadrotor.loops.filters import Pair, Request, butterworth, layout_of, pt1, settled
from eval.quadrotor.plant import Command, make_plant
from eval.quadrotor.stepper import Inputs, hover_state, rollout, step
from eval.quadrotor.vehicle_file import load_vehicle, parse_vehicle, vehicle_table
from tests.support.marks import more
from tests.support.vehicles import at_rest

LAYOUT = layout_of(load_vehicle("crazyflie21").rotors)
LOW_PASSES = [f"{of}_lpf{k}_static_hz" for of in ("gyro", "dterm") for k in (1, 2)]
CUTOFFS = (*LOW_PASSES, "rc_smoothing_setpoint_cutoff", "iterm_relax_cutoff")
UNFILTERED = betaflight.Settings(**dict.fromkeys(CUTOFFS, 0.0))
PLAIN = replace(px4.Settings(), IMU_GYRO_CUTOFF=0.0, IMU_DGYRO_CUTOFF=0.0)
DEFAULTS = {betaflight: UNFILTERED, crazyflie: crazyflie.Settings(), px4: PLAIN}
RIGHT_LEFT, ROOT = np.array([-1.0, -1.0, 1.0, 1.0]), 2.0**-0.5
STILL = [0.0, 0.0, 0.0]


def look(loop, state, throttle, wanted, rate=STILL, settings=None, layout=LAYOUT):
    """Return state and motors after one step of 2 ms; a state of None is that of the start."""
    state = loop.start((), np) if state is None else state
    gains, given = loop.gains(settings or DEFAULTS[loop], layout), (wanted, rate)
    request = Request(np.asarray(throttle), *map(np.array, given), 0.002, np.ones(3))
    return loop.update(gains, state, request)


def test_two_looks_of_betaflight_by_hand():
    """0.1 rad/s is 5.729578 deg/s.

    First: P 0.032029 x 45 x 5.729578 = 8.258054, I 0.244381 x 80 x 5.729578 x 0.002 = 0.224032:
    0.008482086 of the range, 0.945 of a motor's. Second, the set point at 0.12 rad/s (change
    1.1459156 / 0.002 = 572.9578 deg/s^2) and the rate at 0.01 (0.5729578): P 9.083859 (e =
    6.3025357), I 0.224032 + 0.246435, D -0.000529 x 30 x 286.4789 = -4.546420, F 0.00013754 x 120 x
    572.9578 = 9.456555: 14.464461.
    """
    state, motor = look(betaflight, None, 0.5, [0.1, 0.0, 0.0])
    np.testing.assert_allclose(motor, 0.5 + 0.945 * 0.008482086 * RIGHT_LEFT, atol=1e-8)
    state, motor = look(betaflight, state, 0.25, [0.12, 0.0, 0.0], [0.01, 0.0, 0.0])
    np.testing.assert_allclose(motor, 0.25 + 0.945 * 0.014464461 * RIGHT_LEFT, atol=1e-7)


def test_the_i_of_betaflights_yaw_counts_two_and_a_half_times():
    """0.244381 x 80 x 2.5 x 5.729578 x 0.002 of yaw, 0.244381 x 80 x 5.729578 x 0.002 of roll."""
    state, _ = look(betaflight, None, 0.5, [0.1, 0.0, 0.1])
    np.testing.assert_allclose(state.integral, [0.224032, 0.0, 0.560080], atol=1e-6)


def test_betaflights_d_falls_above_the_breakpoint():
    """At full throttle D has lost 65 %: -0.35 x 4.546420."""
    state, _ = look(betaflight, None, 0.6, STILL)
    settings = replace(UNFILTERED, p_roll=0.0, i_roll=0.0)
    _, motor = look(betaflight, state, 0.999999, STILL, [0.01, 0.0, 0.0], settings)
    np.testing.assert_allclose(np.ptp(motor), 2 * 0.945 * 0.35 * 0.004546420, rtol=1e-4)


def test_betaflights_airmode_scales_the_range_and_moves_the_throttle():
    gains = betaflight.gains(UNFILTERED, LAYOUT)
    span, motor = betaflight.mixed(gains, np.asarray(0.0), np.array([0.1, 0.0, 0.0]))
    np.testing.assert_allclose(span, 0.2)
    np.testing.assert_allclose(motor, 0.055 + 0.945 * np.array([0.0, 0.0, 0.2, 0.2]))
    span, motor = betaflight.mixed(gains, np.asarray(0.9), np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(span, 2.0)
    np.testing.assert_allclose(motor, [0.055, 0.055, 1.0, 1.0])


def test_betaflights_integral_stops_near_full_motors_and_by_fast_set_points():
    state, _ = look(betaflight, None, 0.5, [0.1, 0.0, 0.0])
    full = state._replace(span=np.asarray(1.0))
    after, _ = look(betaflight, full, 0.5, [0.1, 0.0, 0.0])
    np.testing.assert_allclose(after.integral, full.integral)
    never = replace(UNFILTERED, iterm_windup=100.0)
    after, _ = look(betaflight, full, 0.5, [0.1, 0.0, 0.0], STILL, never)
    np.testing.assert_allclose(after.integral[0], 2 * 0.224032, atol=1e-6)
    relaxing = replace(UNFILTERED, iterm_relax_cutoff=15.0)
    jump, _ = look(betaflight, state, 0.5, [3.0, 0.0, 0.0], STILL, relaxing)
    np.testing.assert_allclose(jump.integral[0], state.integral[0])


def test_two_looks_of_the_crazyflie_by_hand():
    """0.1 rad/s is 5.729578 deg/s.

    First: P 250 x 5.729578 = 1432.394, I 500 x 5.729578 x 0.002 = 5.729578: 1438.124, half of it
    off M1 and M2 (right) and onto M3 and M4 (left). Second, at 0.01 rad/s: P 1289.155,
    I 500 x 0.021772396 = 10.886198, D -2.5 x 0.5729578 / 0.002 = -716.197: 583.844.
    """
    state = crazyflie.start((), np)
    for rate_x, pwm in ((0.0, 1438.124), (0.01, 583.844)):
        state, motor = look(crazyflie, state, 0.5, [0.1, 0.0, 0.0], [rate_x, 0.0, 0.0])
        np.testing.assert_allclose(motor, 0.5 + 0.5 * pwm / 65535 * RIGHT_LEFT, atol=1e-7)


def test_the_crazyflies_yaw_counts_whole_and_against_the_spin():
    """120 x 5.729578 + 16.7 x 0.01145916 = 687.741 on M2 and M4, which turn clockwise."""
    _, motor = look(crazyflie, None, 0.5, [0.0, 0.0, 0.1])
    share = 687.741 / 65535
    np.testing.assert_allclose(motor, 0.5 + share * np.array([-1, 1, -1, 1]), atol=1e-7)


def test_the_crazyflies_integral_is_limited_but_by_0_and_full_motors_lower_all():
    start = crazyflie.start((), np)
    state = start._replace(integral=np.array([33.2999, 0.0, 0.0]))
    state, motor = look(crazyflie, state, 0.95, [1.0, 0.0, 0.0])
    np.testing.assert_allclose(state.integral[0], 33.3)
    # P 14323.94 + I 16650 = 30973.94: 0.95 +- 0.236316, lowered by 0.186316.
    np.testing.assert_allclose(motor, [0.527368, 0.527368, 1.0, 1.0], atol=1e-5)
    # A limit of 0 is none, as in the firmware.
    free, state = crazyflie.Settings(roll_ilimit=0.0), start._replace(integral=np.array([40, 0, 0]))
    state, _ = look(crazyflie, state, 0.5, [0.1, 0.0, 0.0], STILL, free)
    np.testing.assert_allclose(state.integral[0], 40.0 + 5.729578 * 0.002)


def test_three_looks_of_px4_by_hand():
    """P 0.15 x 0.1 = 0.015, times 0.707 a motor.

    The integral of the first look acts in the second: 0.2 x 0.1 x 0.002 x (1 - (0.1 / 6.981317)^2)
    = 3.999179e-5. At 0.01 rad/s P is 0.0135 and D 0.003 x 0.01 / 0.002 = 0.015.
    """
    state, motor = look(px4, None, 0.5, [0.1, 0.0, 0.0])
    np.testing.assert_allclose(motor, 0.5 + 0.015 * ROOT * RIGHT_LEFT, atol=1e-9)
    np.testing.assert_allclose(state.integral[0], 3.999179e-5, rtol=1e-6)
    state, motor = look(px4, state, 0.5, [0.1, 0.0, 0.0], [0.01, 0.0, 0.0])
    torque = 0.0135 + 3.999179e-5 - 0.015
    np.testing.assert_allclose(motor, 0.5 + torque * ROOT * RIGHT_LEFT, atol=1e-9)


@pytest.mark.parametrize(
    ("thrust", "torque", "motors"),
    [
        # 0.98 +- 0.0707: lowered by 0.0507. Full thrust with 0.1 of yaw: lowered by 0.1.
        (0.98, [0.1, 0.0, 0.0], 1.0 - 0.1 * ROOT * (1.0 - RIGHT_LEFT)),
        (1.0, [0.0, 0.0, 0.1], [0.8, 1.0, 0.8, 1.0]),
        # Without airmode roll is taken back until the lowest motors are at zero.
        (0.02, [0.1, 0.0, 0.0], 0.02 + 0.02 * RIGHT_LEFT),
    ],
)
def test_thrust_gives_way_to_roll_and_yaw_to_thrust_and_none_is_added(thrust, torque, motors):
    given = px4.allocate(LAYOUT, np.asarray(thrust), np.array(torque))
    np.testing.assert_allclose(given, motors, atol=1e-9)


def test_motors_that_hardly_roll_the_body_do_not_limit_its_roll():
    """Motor 1 gives 0.15 of motor 3's roll and would reach 1.004: the clip takes it, not all."""
    layout = LAYOUT._replace(roll=np.array([0.15, -0.15, 1.0, -1.0]), pitch=np.zeros(4))
    given = px4._fit_into_range(np.array([1.004, 0.8, 0.9, 0.9]), px4.columns(layout)[0], 1.0)
    np.testing.assert_array_equal(given, [1.004, 0.8, 0.9, 0.9])


def test_no_integral_of_px4_into_what_the_clip_takes_from_yaw():
    """Torque 0.54 at a thrust of 0.6: 1.14 and 0.06, lowered by 0.14 to 1 and -0.08, clipped to 0.

    Of the 0.54 there are 0.5 left. Nor into a roll that no thrust allows.
    """
    state, _ = look(px4, None, 0.0, [1.0, 0.0, 0.0])
    assert state.lost[0] > 0.1
    after, _ = look(px4, state, 0.0, [1.0, 0.0, 0.0])
    np.testing.assert_allclose(after.integral, state.integral)
    settings = replace(PLAIN, MC_YAWRATE_P=0.54)
    state, motor = look(px4, None, 0.6, [0.0, 0.0, 1.0], STILL, settings)
    np.testing.assert_allclose(motor, [0.0, 1.0, 0.0, 1.0], atol=1e-9)
    np.testing.assert_allclose(state.lost, [0.0, 0.0, 0.04], atol=1e-9)
    after, _ = look(px4, state, 0.6, [0.0, 0.0, 1.0], STILL, settings)
    np.testing.assert_allclose(after.integral, state.integral)


def test_thrust_is_no_torque_on_uneven_arms():
    """Rear arms of half the length: what thrust alone gives is not taken for a lost torque."""
    rotors = load_vehicle("crazyflie21").rotors
    hubs = [(x if x > 0.0 else 0.5 * x, y, z) for x, y, z in rotors.position]
    layout = layout_of(replace(rotors, position=tuple(hubs)))
    state, motor = look(px4, None, 0.5, [0.1, -0.1, 0.05], layout=layout)
    assert 0.0 < motor.min() and motor.max() < 1.0
    np.testing.assert_array_equal(state.lost, 0.0)


def test_the_slope_of_the_gyro_is_filtered_to_first_order():
    """At 30 Hz and 500 Hz k = 0.376991 / 1.376991 = 0.273779 of a slope of 5 rad/s^2."""
    settings = replace(PLAIN, IMU_DGYRO_CUTOFF=30.0)
    state, _ = look(px4, None, 0.5, STILL, STILL, settings)
    for k, left in ((1, 1.0 - 0.273779), (2, (1.0 - 0.273779) ** 2)):
        state, _ = look(px4, state, 0.5, STILL, [0.01 * k, 0.0, 0.0], settings)
        np.testing.assert_allclose(state.accel[0], 5.0 * (1.0 - left), rtol=1e-5)
    # From half the sampling rate on it passes all.
    settings = replace(PLAIN, IMU_DGYRO_CUTOFF=250.0)
    state, _ = look(px4, state, 0.5, STILL, [0.01, 0.0, 0.0], settings)
    np.testing.assert_allclose(state.accel[0], -5.0)


def test_the_integrals_limit_is_one_of_torque():
    """As much with K = 2: 0.3 of roll, of which roll's 0.707 goes to a motor."""
    twice = replace(PLAIN, MC_ROLLRATE_K=2.0)
    state = px4.start((), np)._replace(integral=np.array([0.29999, 0.0, 0.0]))
    after, _ = look(px4, state, 0.5, [0.2, 0.0, 0.0], STILL, twice)
    assert after.integral[0] == PLAIN.MC_RR_INT_LIM == 0.3
    _, motor = look(px4, after, 0.5, STILL, STILL, twice)
    np.testing.assert_allclose(motor, 0.5 + 0.3 * ROOT * RIGHT_LEFT, atol=1e-9)


def test_the_thrust_model_is_undone():
    """0.5 u^2 + 0.5 u = 0.375 at u = 0.5."""
    np.testing.assert_allclose(px4.signal(np.asarray(0.5), np.array([0.375, 1.0])), [0.5, 1.0])
    _, motor = look(px4, None, 0.5, STILL, settings=replace(PLAIN, THR_MDL_FAC=0.3))
    np.testing.assert_allclose(motor, 0.5)


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


@pytest.mark.parametrize("kind", ["px4", *(more(k) for k in ("betaflight", "crazyflie"))])
def test_numpy_and_jax_fly_the_same_and_follow_the_rates(kind):
    plant = make_plant(vehicle(kind), DT)
    given = inputs(160, [1.0, -0.7, 0.4])
    state, motion, rates = hover_state(plant, ()), at_rest(), []
    for k in range(160):
        now = jax.tree.map(lambda value, k=k: value[k], given)
        state, motion, _ = step(plant, state, motion, now, k * DT)
        rates.append(motion.rate_b)
    flown = jax.jit(rollout)(plant, at_rest(), given)
    np.testing.assert_allclose(flown.motion.rate_b[1:], np.array(rates), atol=2e-3)
    np.testing.assert_allclose(rates[-1][:2], [1.0, -0.7], atol=0.3)
    assert rates[-1][2] > 0.05
    assert np.abs(rates[48]).max() < 1e-9


@pytest.mark.parametrize("kind", ["crazyflie", *(more(k) for k in ("betaflight", "px4"))])
def test_a_batch_flies_as_each_alone_and_has_gradients(kind):
    plant = make_plant(vehicle(kind), DT)
    given = inputs(60, [1.0, 0.0, 0.0])
    motion = jax.tree.map(lambda v: np.stack([v, v]), at_rest())
    motion = motion._replace(rate_b=np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]))
    both = jax.tree.map(lambda v: np.stack([v, v], axis=1), given)
    flown = jax.jit(rollout)(plant, motion, both)

    def last(rate_x):
        start = at_rest()._replace(rate_b=jnp.array([rate_x, 0.0, 0.0]))
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
    known = table["controller"][group] if group else table["controller"]
    known["p_rol"] = 1.0
    with pytest.raises(ValueError, match="is unknown"):
        parse_vehicle(table)


def test_rate_gain_scales_the_whole_loop():
    table = vehicle_table(vehicle("px4"))
    table["effects"] = {"rate_gain": {"scale": [0.5, 1.0, 1.0]}}
    weak = make_plant(parse_vehicle(table), DT)
    full = make_plant(vehicle("px4"), DT)
    given, fly = inputs(160, [1.0, 1.0, 0.0]), jax.jit(rollout)  # compiled for the test before
    slow, fast = (fly(plant, at_rest(), given).motion.rate_b[56] for plant in (weak, full))
    np.testing.assert_allclose(slow[0], 0.5 * fast[0], rtol=0.1)
    np.testing.assert_allclose(slow[1], fast[1], rtol=0.01)


def test_first_order_by_hand():
    """2 pi 100 0.002 = 1.256637; k = 1.256637 / 2.256637 = 0.556862."""
    out = pt1(np.array([1.0]), np.array([3.0]), np.asarray(100.0), 0.002)
    np.testing.assert_allclose(out, 1.0 + 2.0 * 0.556862, atol=2e-6)
    np.testing.assert_allclose(pt1(np.array([1.0]), np.array([3.0]), np.asarray(0.0), 0.002), 3.0)


@pytest.mark.parametrize(("hz", "gain"), [more(0.01, 1.0), (30.0, 2.0**-0.5), (240.0, 0.01)])
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

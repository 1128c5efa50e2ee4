"""Air, body, loop and effects as the catalogue has them; the engine against solutions by hand."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval.effects import EFFECTS, nameable_effects
from eval.quadrotor.forces import wind_and_flow, wrench_on
from eval.quadrotor.plant import Motion, accelerations, make_plant, unpack_command
from eval.quadrotor.rotors import steady
from eval.quadrotor.stepper import wanted_speed
from suite.blind.continuous import air, engine, timing
from suite.blind.continuous.body import POS, QUAT, RATE, VEL, Battery, Body
from suite.blind.continuous.quadrotor import CONSTANTS, commanded_speeds, quadrotor_of
from tests.support.vehicles import PLAIN, drawn_effects, with_effects, with_lag

FLIGHTS = 20
OF_THE_LOOP = ("motor_lag", "command_delay", "rate_gain")
ACTING = (*CONSTANTS, *air.THRUSTS, *air.FORCES, *air.TORQUES, "constant_wind")
ACTING = [name for name in ACTING if name not in OF_THE_LOOP]
"""Effects on a body whose rotor speeds are given."""


@pytest.mark.parametrize("names", [[], *([name] for name in ACTING), ACTING], ids="+".join)
@pytest.mark.parametrize("by_time", [True, False])
def test_a_body_accelerates_as_the_catalogue_says(names, by_time):
    rng = np.random.default_rng(1)
    drawn = dict(drawn_effects(rng).effects)
    # A battery falls by time or by voltage.
    sag = (0.01, 0.0) if by_time else (0.0, 0.1)
    drawn |= with_effects(battery_sag=sag).effects
    vehicle = replace(PLAIN, effects={name: drawn[name] for name in names})
    state, still = np.zeros((FLIGHTS, 13)), np.zeros((FLIGHTS, 3))
    # From the ground up to where its effect ends, banked, fast and turning.
    state[:, POS] = rng.uniform([-1.0, -1.0, 0.0], [1.0, 1.0, 0.4], (FLIGHTS, 3))
    turned = Rotation.from_rotvec(rng.uniform(-1.0, 1.0, (FLIGHTS, 3)))
    state[:, QUAT] = turned.as_quat(scalar_first=True)
    state[:, VEL], state[:, RATE] = 5.0 * rng.normal(size=(2, FLIGHTS, 3))
    first, speed, asked = rng.uniform(500.0, 2000.0, (3, FLIGHTS, 4))
    time_s, length_s = rng.uniform(0.0, 60.0, (FLIGHTS, 1)), np.full((FLIGHTS, 1), 0.01)
    quadrotor = quadrotor_of(vehicle)
    wind = air.Wind(quadrotor.effects, FLIGHTS, rng)
    body = Body(quadrotor, wind, Battery(16.0, 0.1, 0.3), np.full((FLIGHTS, 1), 4e6))
    body.begin_row(0.0 * time_s, first)
    spin_up = (asked - speed) / length_s
    change = body.derivative(state, speed, spin_up, time_s, 0.0, still)

    plant, rotors = make_plant(vehicle, 0.01), steady(speed)
    motion = Motion(state[:, POS], turned.as_matrix(), state[:, VEL], state[:, RATE])
    drop = (body.drop(time_s, speed) - body.drop(0.0 * time_s, first))[:, 0]
    _, flow = wind_and_flow(plant, {}, motion, rotors, time_s[:, 0], None, drop)
    flow = flow._replace(rotor_acc=spin_up)
    acc_w, turn_b = accelerations(plant, motion, wrench_on(plant, rotors, flow))
    np.testing.assert_array_equal(change[:, POS], state[:, VEL])
    np.testing.assert_allclose(change[:, VEL], acc_w, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(change[:, RATE], turn_b, rtol=1e-10, atol=1e-9)
    step = Rotation.from_rotvec(1e-6 * state[:, RATE])
    after, before = ((turned * turn).as_quat(scalar_first=True) for turn in (step, step.inv()))
    np.testing.assert_allclose(change[:, QUAT], (after - before) / 2e-6, atol=1e-8)


def test_a_battery_is_full_until_the_first_row():
    sag = SimpleNamespace(rate=0.01, per_volt=0.0)
    at = SimpleNamespace(time_s=np.array([[-1.0], [4.0]]), fallen_v=0.0)
    thrust = air.THRUSTS["battery_sag"](sag, at, np.ones((2, 4)))  # type: ignore[arg-type]
    np.testing.assert_allclose(thrust, [[1.0] * 4, [0.96] * 4])


def wind_of(flights, **effects):
    return air.Wind(dict(with_effects(**effects).effects), flights, np.random.default_rng(1))


def test_without_wind_the_air_is_still_and_a_steady_wind_does_not_change():
    steady_w = (1.0, -2.0, 0.5)
    for effects, wind_w in (({}, (0, 0, 0)), ({"constant_wind": (steady_w,)}, steady_w)):
        wind = wind_of(2, **effects)
        wind.step(np.ones((2, 3)), np.full((2, 1), 0.1))
        for part in (wind.start_w, wind.end_w):
            np.testing.assert_array_equal(part, [wind_w] * 2)


def test_gusts_have_their_intensity_and_forget_with_their_length():
    wind = wind_of(20_000, gusts=(1.5, 4.0), constant_wind=((2.0, 0.0, 0.0),))
    # 7 m/s over ground against a mean wind of 2 m/s along it: 5 m/s through the air.
    vel_w, length_s = np.tile([7.0, 0.0, 0.0], (20_000, 1)), np.full((20_000, 1), 0.02)
    first = wind.end_w - [2.0, 0.0, 0.0]
    for _ in range(20):
        before = wind.end_w
        wind.step(vel_w, length_s)
        np.testing.assert_array_equal(wind.start_w, before)
    last = wind.end_w - [2.0, 0.0, 0.0]
    for series in (first, last):
        np.testing.assert_allclose(series.std(axis=0), [1.5, 1.5, 0.75], rtol=0.02)
    # After 0.4 s: exp(-0.4 x 5 / 4).
    kept = (first * last).mean(axis=0) / (first**2).mean(axis=0)
    np.testing.assert_allclose(kept, np.exp(-0.5), atol=0.02)
    wind.step(vel_w, 0.0 * length_s)
    np.testing.assert_array_equal(wind.start_w, wind.end_w)


def test_a_slow_vehicle_sees_gusts_change_as_at_a_metre_a_second():
    wind = wind_of(20_000, gusts=(1.0, 2.0))
    wind.step(np.zeros((20_000, 3)), np.full((20_000, 1), 1.0))
    kept = (wind.start_w * wind.end_w).mean() / (wind.start_w**2).mean()
    assert kept == pytest.approx(np.exp(-0.5), abs=0.02)


def test_the_controller_is_the_documented_one_with_nominal_constants():
    """Within the rotors' range and beyond it, tests/eval/quadrotor works it by hand."""
    rng = np.random.default_rng(0)
    command = rng.uniform([-5.0, -9.0, -9.0, -9.0], [60.0, 9.0, 9.0, 9.0], (2000, 4))
    command[:1000, 1:] *= 0.1
    rate_b = rng.uniform(-1.0, 1.0, (2000, 3)) * rng.choice([0.3, 3.0], (2000, 1))
    truth = with_effects(
        rate_gain=((0.5, 2.0, 1.5),), mass_offset=(0.05,), inertia_scale=((1.1, 0.9, 1.2),),
        thrust_scale=(0.9,), com_offset=((0.005, -0.01, 0.02),), weak_motor=((1.0, 0.8, 1.0, 1.0),),
    )  # fmt: skip
    nominal, push = quadrotor_of(truth).nominal, 1.6e-6
    here = push * commanded_speeds(nominal, command, rate_b) ** 2
    there = push * wanted_speed(make_plant(truth, 0.002), unpack_command(command), rate_b) ** 2
    np.testing.assert_allclose(here, there, rtol=1e-9, atol=2e-6)
    most = push * 2100.0**2
    free = ((here > 1e-3) & (here < most - 1e-3)).all(axis=1)
    assert here.max() == pytest.approx(most) and 0.1 < free.mean() < 0.9


def test_lag_delay_and_every_effect_of_the_catalogue_have_an_equation_and_another_is_refused():
    assert quadrotor_of(PLAIN)[-3:-1] == (0.0, 0.0)
    late = quadrotor_of(with_effects(motor_lag=(0.04,), command_delay=(0.013,)))
    assert (late.time_constant, late.delay) == (0.04, 0.013)
    drawn = drawn_effects(np.random.default_rng(0)).effects
    assert set(drawn) == set(EFFECTS)
    quadrotor_of(replace(PLAIN, effects={name: drawn[name] for name in nameable_effects()}))
    with pytest.raises(ValueError, match="effects.slung_load: .* no equation for it"):
        quadrotor_of(with_effects(slung_load=(0.05, 0.5)))
    odd = with_effects()
    object.__setattr__(odd, "effects", {"ripple": None})
    with pytest.raises(ValueError, match="effects.ripple: .* no equation for it; allowed: .*gusts"):
        quadrotor_of(odd)


BATTERY = Battery(16.5, 0.02, 0.35)
HOVER = 9.81


def flown(vehicle, stamps, commands, speed=(0.0, 0.0, 0.0), push=None, loop_s=0.002, step_s=1e-3):
    """One flight from level, with `commands` (thrust, rates) row by row."""
    quadrotor = quadrotor_of(vehicle)
    start = np.zeros((1, 13))
    start[0, POS], start[0, VEL], start[0, QUAT] = [0, 0, 5.0], speed, [1, 0, 0, 0]
    stamps = np.array(stamps, dtype=float)[:, None]

    def pilot(seen):
        command = np.array([commands[min(seen.number, len(commands) - 1)]], dtype=float)
        return command, command

    plan = timing.schedule(stamps, loop_s, quadrotor.delay, step_s)
    return engine.fly(quadrotor, plan, start, pilot, np.random.default_rng(0), BATTERY, push)


def test_a_rotors_lag_is_that_of_first_order():
    # Omega from a to b: thrust is k (b + (a - b) e^(-t/tau))^2, summed by hand over 0.1 s.
    tau, time_s = 0.03, 0.1
    run = flown(with_lag(PLAIN, tau), [0.0, time_s], [(14.0, 0, 0, 0)])
    a, b = (np.sqrt(0.75 * c / 4 / 1.6e-6) for c in (HOVER, 14.0))
    left = np.exp(-time_s / tau)
    np.testing.assert_allclose(run.speed[-1, 0], b + (a - b) * left, rtol=1e-12)
    square = b**2 * time_s + 2 * b * (a - b) * tau * (1 - left)
    square += (a - b) ** 2 * tau / 2 * (1 - left**2)
    climb = 4 * 1.6e-6 * square / 0.75 - HOVER * time_s
    assert run.state[-1, 0, VEL][2] == pytest.approx(climb, rel=1e-9)


def test_the_rate_loop_measures_at_its_ticks_and_at_rows_and_not_at_a_late_command():
    # Held torque: a period of length h moves the rate by K h (command - rate).
    run = flown(PLAIN, [0.0, 0.0037, 0.01], [(HOVER, 0.4, 0, 0), (HOVER, 0.4, 0, 0)])
    rate, expected = 0.0, []
    for held in (0.002, 0.0017, 0.002, 0.002, 0.002, 0.0003):
        rate += 20.0 * held * (0.4 - rate)
        expected.append(rate)
    ticks = np.flatnonzero(run.schedule.is_tick[:, 0])
    np.testing.assert_allclose(run.state[ticks[1:], 0, RATE][:, 0], expected[:-1], rtol=1e-9)
    assert run.state[-1, 0, RATE][0] == pytest.approx(expected[-1], rel=1e-9)
    late = with_effects(command_delay=(0.0013,))
    run = flown(late, [0.0, 0.002, 0.004], [(HOVER, 0.4, 0, 0), (HOVER, -5.0, 0, 0)])
    measured = 20.0 * 0.4 * 0.0007
    end = measured + 20.0 * (0.4 - measured) * 0.0013 + 20.0 * (-5.0 - measured) * 0.0007
    assert run.state[-1, 0, RATE][0] == pytest.approx(end, rel=1e-9)


def test_a_push_is_felt_and_kept():
    def push(seen, force_b, length_s):
        assert force_b[0, 2] == pytest.approx(0.75 * HOVER)
        return np.array([[0.75, 0.0, 0.0]])

    run = flown(PLAIN, [0.0, 0.5], [(HOVER, 0, 0, 0)], push=push)
    assert run.state[-1, 0, VEL][0] == pytest.approx(0.5) and run.push_b[3, 0, 0] == 0.75
    many = flown(PLAIN, [0.0, 0.1, 0.2, 0.3], [(HOVER, 0, 0, 0)] * 3, push=push)
    assert many.acc_b[1:, 0, 0] == pytest.approx(np.full(2, 0.75 / PLAIN.mass))


def test_the_accelerometer_is_that_of_before_the_command_and_the_voltage_falls_from_the_first_row():
    run = flown(PLAIN, [0.0, 0.5, 1.0], [(HOVER, 0, 0, 0), (2 * HOVER, 0, 0, 0)])
    np.testing.assert_allclose(run.acc_b[:, 0], [[0, 0, HOVER]] * 2, atol=1e-12)
    np.testing.assert_allclose(run.voltage[:, 0], [16.5, 16.5 - 0.02 * 0.5])
    later = flown(PLAIN, [0.0, 0.5, 1.0, 1.5], [(2 * HOVER, 0, 0, 0)])
    # Twice the squared speeds of a hover cost 0.35 V more.
    assert later.voltage[2, 0] == pytest.approx(16.5 - 0.02 - 0.35)
    assert later.acc_b[2, 0, 2] == pytest.approx(2 * HOVER)
    run = flown(with_effects(battery_sag=(0.0, 0.1)), [-0.2, 0.0, 0.5], [(2 * HOVER, 0, 0, 0)])
    # The first row, at time 0, sees 16.15 V; half a second later it is 10 mV less.
    np.testing.assert_allclose(run.voltage[:, 0], [16.5, 16.15])
    climb = run.state[-1, 0, VEL][2] - run.state[run.schedule.block[1], 0, VEL][2]
    assert climb == pytest.approx(HOVER * 0.5 - 2 * HOVER * 0.1 * 0.02 * 0.5**2 / 2, rel=1e-6)

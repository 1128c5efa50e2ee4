"""Air, body and effects as the catalogue has them, which has tests worked by hand; and the wind."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval.quadrotor.forces import wind_and_flow, wrench_on
from eval.quadrotor.plant import Motion, accelerations, make_plant
from eval.quadrotor.rotors import steady
from suite.blind.continuous.air import FORCES, THRUSTS, TORQUES, Wind
from suite.blind.continuous.body import POS, QUAT, RATE, VEL, Battery, Body
from suite.blind.continuous.quadrotor import CONSTANTS, quadrotor_of
from tests.support.vehicles import PLAIN, drawn_effects, with_effects

FLIGHTS = 20
ACTING = [
    name
    for name in (*CONSTANTS, *THRUSTS, *FORCES, *TORQUES, "constant_wind")
    if name not in ("motor_lag", "command_delay", "rate_gain")
]
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
    wind = Wind(quadrotor.effects, FLIGHTS, rng)
    body = Body(quadrotor, wind, Battery(16.0, 0.1, 0.3), np.full((FLIGHTS, 1), 4e6))
    body.begin_row(0.0 * time_s, first)
    body.set_command(speed, asked, length_s)
    change = body.derivative(state, speed, time_s, 0.0, still)

    plant, rotors = make_plant(vehicle, 0.01), steady(speed)
    motion = Motion(state[:, POS], turned.as_matrix(), state[:, VEL], state[:, RATE])
    drop = (body.drop(time_s, speed) - body.drop(0.0 * time_s, first))[:, 0]
    _, flow = wind_and_flow(plant, {}, motion, rotors, time_s[:, 0], None, drop)
    flow = flow._replace(rotor_acc=(asked - speed) / length_s)
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
    thrust = THRUSTS["battery_sag"](sag, at, np.ones((2, 4)))  # type: ignore[arg-type]
    np.testing.assert_allclose(thrust, [[1.0] * 4, [0.96] * 4])


def test_no_wind_is_still_and_a_steady_one_does_not_change():
    assert Wind({}, 2, np.random.default_rng(0)).still
    effects = dict(with_effects(constant_wind=((1.0, -2.0, 0.5),)).effects)
    wind = Wind(effects, 2, np.random.default_rng(0))
    for part in wind.step(np.zeros((2, 3)), np.full((2, 1), 0.1)):
        np.testing.assert_array_equal(part, [[1.0, -2.0, 0.5]] * 2)
    assert not wind.still


def gusts(*values, **others):
    """Return the gusts of 20,000 flights with the intensity [m/s] and length [m] in `values`."""
    effects = dict(with_effects(gusts=values, **others).effects)
    return Wind(effects, 20_000, np.random.default_rng(1))


def test_gusts_have_their_intensity_and_forget_with_their_length_at_a_metre_a_second_or_more():
    wind = gusts(1.5, 4.0, constant_wind=((2.0, 0.0, 0.0),))
    # 7 m/s over ground against a mean wind of 2 m/s along it: 5 m/s through the air.
    vel_w, length_s = np.tile([7.0, 0.0, 0.0], (20_000, 1)), np.full((20_000, 1), 0.02)
    first = wind.now_w - [2.0, 0.0, 0.0]
    for _ in range(19):
        wind.step(vel_w, length_s)
    _, after = wind.step(vel_w, length_s)
    last = after - [2.0, 0.0, 0.0]
    for series in (first, last):
        np.testing.assert_allclose(series.std(axis=0), [1.5, 1.5, 0.75], rtol=0.02)
    # After 0.4 s: exp(-0.4 x 5 / 4).
    kept = (first * last).mean(axis=0) / (first**2).mean(axis=0)
    np.testing.assert_allclose(kept, np.exp(-0.5), atol=0.02)
    np.testing.assert_array_equal(wind.now_w, after)
    np.testing.assert_array_equal(*wind.step(vel_w, 0.0 * length_s))
    wind = gusts(1.0, 2.0)
    first = wind.now_w
    _, after = wind.step(np.zeros((20_000, 3)), np.full((20_000, 1), 1.0))
    assert (first * after).mean() / (first**2).mean() == pytest.approx(np.exp(-0.5), abs=0.02)

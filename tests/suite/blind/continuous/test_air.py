"""Every effect that acts in flight, against numbers worked by hand from the catalogue's table."""

from types import SimpleNamespace

import numpy as np
import pytest

from suite.blind.continuous.air import FORCES, THRUSTS, TORQUES, Moment, Wind
from tests.support.vehicles import with_effects

# Body x points along world y, body y along world -x.
QUARTER = np.array([[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
ARM = np.array([[0.1, -0.1, 0.0], [-0.1, -0.1, 0.0], [-0.1, 0.1, 0.0], [0.1, 0.1, 0.02]])


def moment(**given):
    values = {
        "mass": 0.5,
        "inertia": np.array([0.002, 0.003, 0.004]),
        "arm": ARM,
        "spin": np.array([1.0, -1.0, 1.0, -1.0]),
        "pos_w": np.array([[0.0, 0.0, 0.05]]),
        "rot_w": QUARTER,
        "air_b": np.array([[3.0, -4.0, 2.0]]),
        "rate_b": np.array([[2.0, -1.0, 0.5]]),
        "speed": np.array([[1000.0, 900.0, 1100.0, 800.0]]),
        "time_s": np.array([[4.0]]),
        "fallen_v": np.array([[0.5]]),
    }
    return Moment(**(values | given))


def effect(**values):
    return SimpleNamespace(**values)


FAST = {"air_b": np.array([[3.0, -4.0, 12.0]])}
SPINNING_UP = {"spin_up": np.array([[100.0, -50.0, 0.0, 25.0]])}
BY_HAND = [
    # -0.5 kg x (0.3, 0.2, 0.1) 1/s x (3, -4, 2) m/s
    (FORCES, "linear_drag", {"coefficient": (0.3, 0.2, 0.1)}, {}, [-0.45, 0.4, -0.1]),
    # |v| = sqrt(9 + 16 + 144) = 13; -0.5 x 13 x (0.01, 0.02, 0.03) x (3, -4, 12)
    (FORCES, "quadratic_drag", {"coefficient": (0.01, 0.02, 0.03)}, FAST, [-0.195, 0.52, -2.34]),
    # -1e-5 kg/rad x 3800 rad/s x (3, -4, 0) m/s
    (FORCES, "rotor_drag", {"coefficient": 1e-5}, {}, [-0.114, 0.152, 0.0]),
    # 0.5 kg x 0.02 1/m x 25 m^2/s^2, up
    (FORCES, "translational_lift", {"coefficient": 0.02}, {}, [0.0, 0.0, 0.25]),
    # v x e3 = (v_y, -v_x, 0): 1e-6 x 3800 x (-4, -3, 0). Flying forward pitches the nose up.
    (TORQUES, "blade_flapping", {"coefficient": 1e-6}, {}, [-0.0152, -0.0114, 0.0]),
    (TORQUES, "torque_trim", {"torque": (0.01, -0.02, 0.003)}, {}, [0.01, -0.02, 0.003]),
    # sum s Omega = 1000 - 900 + 1100 - 800 = 400; w x e3 = (-1, -2, 0)
    (TORQUES, "rotor_gyroscopic", {"rotor_inertia": 1e-5}, {}, [0.004, 0.008, 0.0]),
    # 100 + 50 + 0 - 25 = 125 (clockwise ones count against): -2e-5 x 125
    (TORQUES, "rotor_spin_up", {"rotor_inertia": 2e-5}, SPINNING_UP, [0.0, 0.0, -0.0025]),
    # -(0.002, 0.003, 0.004) x (1, 2, 3) x (2, -1, 0.5)
    (TORQUES, "angular_damping", {"coefficient": (1.0, 2.0, 3.0)}, {}, [-0.004, 0.006, -0.006]),
]


@pytest.mark.parametrize(("kind", "name", "values", "given", "hand"), BY_HAND)
def test_forces_and_torques(kind, name, values, given, hand):
    np.testing.assert_allclose(kind[name](effect(**values), moment(**given)), [hand], atol=1e-15)


def test_inflow():
    # Climbing at 2 m/s: each rotor loses 1e-4 x Omega x 2.
    thrust = THRUSTS["inflow"](effect(coefficient=1e-4), moment(), np.full((1, 4), 2.0))
    np.testing.assert_allclose(thrust, [[1.8, 1.82, 1.78, 1.84]], atol=1e-15)


def test_ground_effect_goes_by_each_rotors_height():
    # z = 0.05 m: 1 / (1 - 2 (0.06 / 0.2)^2) = 1 / 0.82; the fourth hub is 0.02 m higher.
    values = effect(strength=2.0, rotor_radius=0.06)
    thrust = THRUSTS["ground_effect"](values, moment(), np.ones((1, 4)))
    high = 1.0 / (1.0 - 2.0 * (0.06 / 0.28) ** 2)
    np.testing.assert_allclose(thrust, [[1.0 / 0.82] * 3 + [high]], rtol=1e-14)


def test_ground_effect_sees_a_bank_and_is_capped():
    # Rolled by 0.3 rad: hubs on the left (y = 0.1) are sin(0.3) x 0.1 m higher.
    cos, sin = np.cos(0.3), np.sin(0.3)
    rolled = np.array([[[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]]])
    values = effect(strength=1.0, rotor_radius=0.06)
    at = moment(rot_w=rolled, pos_w=np.array([[0.0, 0.0, 0.09]]))
    thrust = THRUSTS["ground_effect"](values, at, np.ones((1, 4)))
    left, right = (
        1.0 / (1.0 - (0.06 / (4.0 * (0.09 + 0.1 * side * sin))) ** 2) for side in (1, -1)
    )
    assert thrust[0, 2] == pytest.approx(left) and thrust[0, 0] == pytest.approx(right)
    low = moment(pos_w=np.array([[0.0, 0.0, 0.001]]))
    assert THRUSTS["ground_effect"](values, low, np.ones((1, 4)))[0, 0] == pytest.approx(1.5)


@pytest.mark.parametrize(
    ("values", "given", "share"),
    [
        ({"rate": 0.01, "per_volt": 0.0}, {}, 0.96),
        ({"rate": 0.0, "per_volt": 0.1}, {}, 0.95),
        ({"rate": 0.01, "per_volt": 0.0}, {"time_s": np.array([[-1.0]])}, 1.0),
    ],
)
def test_battery_sag_by_time_and_by_voltage(values, given, share):
    found = THRUSTS["battery_sag"](effect(**values), moment(**given), np.ones((1, 4)))
    np.testing.assert_allclose(found, share)


def test_thrusts_are_added_to_before_they_are_scaled():
    assert list(THRUSTS) == ["inflow", "ground_effect", "battery_sag"]


def test_no_wind_is_still_and_a_steady_one_does_not_change():
    assert Wind({}, 2, np.random.default_rng(0)).still
    effects = dict(with_effects(constant_wind=((1.0, -2.0, 0.5),)).effects)
    wind = Wind(effects, 2, np.random.default_rng(0))
    before, after = wind.step(np.zeros((2, 3)), np.full((2, 1), 0.1))
    np.testing.assert_array_equal(before, [[1.0, -2.0, 0.5]] * 2)
    np.testing.assert_array_equal(after, before)
    assert not wind.still


def test_gusts_have_their_intensity_and_forget_with_their_length():
    effects = dict(with_effects(gusts=(1.5, 4.0), constant_wind=((2.0, 0.0, 0.0),)).effects)
    wind = Wind(effects, 20_000, np.random.default_rng(1))
    # 7 m/s over ground against a mean wind of 2 m/s along it: 5 m/s through the air.
    vel_w, length_s = np.tile([7.0, 0.0, 0.0], (20_000, 1)), np.full((20_000, 1), 0.002)
    first = wind.now_w - [2.0, 0.0, 0.0]
    for _ in range(199):
        wind.step(vel_w, length_s)
    _, after = wind.step(vel_w, length_s)
    last = after - [2.0, 0.0, 0.0]
    for series in (first, last):
        np.testing.assert_allclose(series.std(axis=0), [1.5, 1.5, 0.75], rtol=0.02)
    # After 0.4 s: exp(-0.4 x 5 / 4).
    kept = (first * last).mean(axis=0) / (first**2).mean(axis=0)
    np.testing.assert_allclose(kept, np.exp(-0.5), atol=0.02)
    np.testing.assert_array_equal(wind.now_w, after)
    still = wind.step(vel_w, 0.0 * length_s)
    np.testing.assert_array_equal(*still)


def test_a_slow_vehicle_sees_gusts_change_as_at_a_metre_a_second():
    effects = dict(with_effects(gusts=(1.0, 2.0)).effects)
    wind = Wind(effects, 20_000, np.random.default_rng(1))
    first = wind.now_w
    _, after = wind.step(np.zeros((20_000, 3)), np.full((20_000, 1), 1.0))
    assert (first * after).mean() / (first**2).mean() == pytest.approx(np.exp(-0.5), abs=0.02)

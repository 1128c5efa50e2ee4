"""What RotorPy is told of a vehicle, worked by hand; and that it does as our file says."""

from dataclasses import replace

import numpy as np
import pytest

from eval.effects import EFFECTS
from eval.quadrotor.forces import wind_and_flow, wrench_on
from eval.quadrotor.plant import Motion, make_plant
from eval.quadrotor.rotors import steady
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.rotorpy_vehicle import AIR, differences, rotorpy_parameters
from tests.support.vehicles import PLAIN, drawn_effects, with_effects, with_lag


def test_our_numbers_become_rotorpys():
    truth = with_effects(
        quadratic_drag=((0.1, 0.2, 0.3),), rotor_drag=(1e-5,), blade_flapping=(2e-6,),
        translational_lift=(0.4,), mass_offset=(0.05,),
    )  # fmt: skip
    told = rotorpy_parameters(truth)
    assert told["mass"] == pytest.approx(0.8)
    assert [told[key] for key in ("c_Dx", "c_Dy", "c_Dz")] == pytest.approx([0.08, 0.16, 0.24])
    assert told["k_d"] == 1e-5 and told["k_flap"] == -2e-6, "of the opposite sign there"
    assert told["k_h"] == pytest.approx(0.25 * 0.8 * 0.4) and told["k_z"] == 0.0
    assert [told[key] for key in ("Ixx", "Iyy", "Izz")] == pytest.approx(PLAIN.inertia)
    assert told["k_eta"] == pytest.approx(1.6e-6) and told["k_m"] == pytest.approx(2.2e-8)
    np.testing.assert_array_equal(told["rotor_directions"], [-1, 1, -1, 1])
    np.testing.assert_allclose(told["rotor_pos"]["r2"], PLAIN.rotors.position[1])


def test_motors_behind_a_firmwares_loop_may_turn_as_fast_as_their_curve_says():
    crazyflie = load_vehicle("crazyflie21")
    assert crazyflie.motors is not None
    full = np.sqrt(sum(crazyflie.motors.thrust) / crazyflie.rotors.thrust_coefficient)
    assert full > crazyflie.rotors.speed_max
    assert rotorpy_parameters(crazyflie)["rotor_speed_max"] == pytest.approx(full)
    plain = replace(crazyflie, controller=PLAIN.controller)
    assert rotorpy_parameters(plain)["rotor_speed_max"] == crazyflie.rotors.speed_max


def test_linear_drag_becomes_drag_of_rotors_that_is_the_same_at_hover():
    told = rotorpy_parameters(with_effects(linear_drag=((0.2, 0.4, 0.8),), rotor_drag=(1e-5,)))
    hover = np.sqrt(0.75 * 9.81 / (4 * 1.6e-6))
    assert 4 * hover * (told["k_d"] - 1e-5) == pytest.approx(0.75 * 0.3)
    assert 4 * hover * told["k_z"] == pytest.approx(0.75 * 0.8)


def test_an_effect_that_it_has_not_touches_no_parameter():
    lame = with_effects(weak_motor=((0.5, 1.0, 1.0, 1.0),), thrust_tilt=((0.1, 0.0),))
    assert rotorpy_parameters(lame)["k_eta"] == rotorpy_parameters(PLAIN)["k_eta"]


def test_rotors_lag_at_least_as_long_as_asked():
    assert rotorpy_parameters(PLAIN)["tau_m"] == 0.0
    assert rotorpy_parameters(PLAIN, 0.002)["tau_m"] == 0.002
    assert rotorpy_parameters(with_lag(PLAIN, 0.03), 0.002)["tau_m"] == 0.03


def test_every_difference_is_said_and_nothing_else():
    assert differences(with_lag(PLAIN, 0.03), 0.002) == []
    assert "flown with 0.002 s" in differences(PLAIN, 0.002)[0]
    said = " ".join(differences(drawn_effects(np.random.default_rng(0), PLAIN), 0.002))
    without = [name for name in EFFECTS if f"{name}: RotorPy does not have it" in said]
    assert set(without) == {
        "rotor_gyroscopic", "ground_effect", "battery_sag", "angular_damping", "thrust_tilt",
        "torque_trim", "frame_tilt", "weak_motor", "rotor_spin_up", "slung_load",
    }  # fmt: skip
    assert "linear_drag: RotorPy's drag is proportional to the rotors' speed" in said
    assert "gusts" not in said and "gyro_bias" not in said


@pytest.mark.parametrize("name", [*AIR, "com_offset", "thrust_scale", None])
def test_forces_and_torques_are_ours_where_the_body_does_not_turn(name):
    """To rounding: RotorPy's equations in other words. Turning, its hubs have airspeeds of their
    own, which ours have not (`differences` says so)."""
    rotorpy = pytest.importorskip("rotorpy.vehicles.multirotor")
    rng = np.random.default_rng(3)
    drawn = drawn_effects(rng).effects
    vehicle = replace(with_lag(PLAIN, 0.03), effects={name: drawn[name]} if name else {})
    plant = make_plant(vehicle, 0.002)
    theirs = rotorpy.Multirotor(rotorpy_parameters(vehicle))
    for _ in range(5):
        vel_b, speed = rng.normal(0, 6, 3), rng.uniform(300, 2000, 4)
        motion = Motion(np.zeros(3), np.eye(3), vel_b, np.zeros(3))
        _, flow = wind_and_flow(plant, {}, motion, steady(speed), 0.0)
        ours = wrench_on(plant, steady(speed), flow)
        force_b, torque_b = theirs.compute_body_wrench(np.zeros(3), speed, vel_b)
        np.testing.assert_allclose(force_b, ours.force_b, rtol=1e-9, atol=1e-9)
        if name == "rotor_drag":  # at its hubs: no torque of theirs where all turn alike
            alike = np.full(4, speed[0])
            torque_b = theirs.compute_body_wrench(np.zeros(3), alike, vel_b)[1]
            ours = wrench_on(plant, steady(alike), flow._replace(rotor_speed=alike))
        np.testing.assert_allclose(torque_b, ours.torque_b, rtol=1e-9, atol=1e-9)

"""The simulator rotorpy: without RotorPy, what it is told of a vehicle, and trials in it."""

import builtins
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from eval.effects import EFFECTS
from eval.judging.judge import Record
from eval.quadrotor.forces import wind_and_flow, wrench_on
from eval.quadrotor.plant import Motion, make_plant
from eval.quadrotor.rotors import steady
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds import differences as differences_of
from eval.worlds import rotorpy as rotorpy_world
from eval.worlds import world_class
from eval.worlds.rotorpy import Multirotor, StepInput
from eval.worlds.rotorpy_vehicle import AIR, as_flown, differences, rotorpy_parameters
from eval.worlds.trial import Rules
from tests.support import commands
from tests.support.courses import fly_on, straight
from tests.support.engines import STAND_IN
from tests.support.pilots import Pursuit, Steady
from tests.support.vehicles import PLAIN, drawn_effects, with_effects, with_lag

VEHICLE = load_vehicle("reference")
flown = partial(fly_on, vehicle=VEHICLE, world="rotorpy", slots=3)
TRACK, RULES = straight(), Rules(time_limit_s=4.0)


@pytest.fixture
def stand_in(monkeypatch):
    monkeypatch.setattr(rotorpy_world, "rotorpy", lambda: STAND_IN)


@pytest.mark.parametrize("missing", ["rotorpy", "roma"])
def test_without_rotorpy_the_install_line_is_said(missing, monkeypatch, tmp_path, capsys):
    monkeypatch.delitem(sys.modules, "rotorpy.vehicles.multirotor", raising=False)
    for name in ("rotorpy", "rotorpy.vehicles", "torchdiffeq", "roma"):
        if name.startswith(missing):
            monkeypatch.setitem(sys.modules, name, None)
        elif name not in sys.modules:
            monkeypatch.setitem(sys.modules, name, builtins)
    line = "pip install 'diffracing-suite[rotorpy]'"
    with pytest.raises(ValueError, match="world 'rotorpy' needs the package") as refused:
        world_class("rotorpy")
    assert line in str(refused.value)
    assert line in commands.refused(capsys, "eval --simulator rotorpy --out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.extended
def test_the_body_falls_as_the_simulator_says_and_touches_our_ground(stand_in):
    (result,), (flight,) = flown(Steady(), TRACK, record=Record(), rules=RULES)
    assert result[8:10] == ("collision", "ground") and result.world == "rotorpy"
    assert result.time_s == pytest.approx(np.sqrt(2 * 1.475 / 9.81), abs=0.003)
    assert torch.get_default_dtype() is torch.float32, "left as it was"
    # Rows are the simulator's states, and count as continuous.
    t = flight.time_s
    np.testing.assert_allclose(flight.pos_w[:, 2], 1.5 - 0.5 * 9.81 * t**2, atol=1e-9)
    np.testing.assert_allclose(flight.vel_w[:, 2], -9.81 * t, atol=1e-9)
    assert "integrator" not in flight.about and flight.about["world"] == "rotorpy"


def test_a_state_that_is_none_ends_that_trial_only(stand_in, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo would leave its log here
    step = Multirotor.step

    def broken(self, qpos, qvel, speed, push):
        after, *rest = step(self, qpos, qvel, speed, push)
        return np.where((qpos[:, 2] < 5.0)[:, None], np.nan, after), *rest

    monkeypatch.setattr(Multirotor, "step", broken)
    high, low = straight(height=30.0, name="high"), straight(height=5.5, name="low")
    ends, _ = flown(Steady(), high, low, rules=Rules(time_limit_s=1.0))
    assert [end.ended_by for end in ends] == ["timeout", "diverged"]
    assert 4.9 < ends[1].pos_z < 5.1 and list(tmp_path.iterdir()) == []


def test_what_the_vehicle_loses_is_said(stand_in):
    lame = with_effects(with_lag(PLAIN, 0.03), weak_motor=((0.8, 1.0, 1.0, 1.0),))
    (said,) = differences_of("rotorpy", lame)
    assert said == "weak_motor: RotorPy does not have it; flown without"
    assert differences_of("mujoco", lame) == []


# From here on RotorPy itself flies.


@pytest.mark.extended
def test_one_trial_is_finished_and_another_ends_at_a_wall():
    clear, walled = straight((0.6, 1.2), name="clear"), straight((4.0, 5.0), 0.8, name="walled")
    record = Record(depth=True)
    (result, hit), (flight, _) = flown(Pursuit(3.0), clear, walled, rules=RULES, record=record)
    assert (hit.ended_by, hit.collided_with) == ("collision", "the wall")
    assert (result.ended_by, result.gates_passed, result.gates_035) == ("finished", 2, 2)
    assert 1.0 < result.v_mean < result.v_max < 3.5
    assert flight.depth_m.shape[1:] == (24, 32)
    assert np.ptp(flight.rotor_speed[1:], axis=0).min() > 10.0


@pytest.mark.slow
def test_wind_carries_the_vehicle_by_rotorpys_drag():
    rules = Rules(time_limit_s=0.4)
    (still,), _ = flown(Steady(), TRACK, rules=rules)
    wind = with_effects(constant_wind=((0.0, 4.0, 0.0),)).effects
    blown = replace(VEHICLE, effects={**VEHICLE.effects, **wind})
    (carried,), _ = flown(Steady(), TRACK, vehicle=blown, rules=rules)
    assert abs(still.pos_y) < 1e-6 and carried.pos_y > 0.02


def test_a_row_is_stepped_by_itself():
    """So a trial's outcome does not depend on the others of its batch."""
    rng, count = np.random.default_rng(0), 3
    qpos = rng.normal(size=(64, 7))
    qpos[:, 3:] /= np.linalg.norm(qpos[:, 3:], axis=1, keepdims=True)
    qvel, speed = rng.normal(0, 4, (64, 6)), rng.uniform(300, 1800, (64, 4))
    push = StepInput(rng.uniform(300, 1800, (64, 4)), rng.normal(size=(64, 3)))
    whole = Multirotor(VEHICLE, 0.002, 64).step(qpos, qvel, speed, push)
    parts = qpos[:count], qvel[:count], speed[:count], StepInput(*(p[:count] for p in push))
    few = Multirotor(VEHICLE, 0.002, count).step(*parts)
    for part, of_few in zip(whole, few, strict=True):
        np.testing.assert_array_equal(part[:count], of_few)


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


def test_the_mass_is_the_true_one_and_rotors_lag_at_least_as_long_as_asked():
    heavy = with_effects(mass_offset=(0.05,), quadratic_drag=((0.1, 0.2, 0.3),))
    told = [rotorpy_parameters(heavy)[name] for name in ("mass", "c_Dx", "c_Dy", "c_Dz")]
    assert told == pytest.approx([0.8, 0.08, 0.16, 0.24])
    assert rotorpy_parameters(PLAIN)["tau_m"] == 0.0


def test_every_difference_is_said_and_nothing_else():
    alike = with_lag(PLAIN, 0.03)
    assert differences(alike) == [] and as_flown(alike) is alike
    assert "flown with 0.002 s" in differences(PLAIN)[0]
    biased = with_effects(gyro_bias=((0.1, 0.0, 0.0),))
    assert as_flown(PLAIN).effects == {"motor_lag": (0.002,)}
    assert as_flown(biased).effects == {**biased.effects, "motor_lag": (0.002,)}
    said = " ".join(differences(drawn_effects(np.random.default_rng(0), PLAIN)))
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
    from rotorpy.vehicles import multirotor

    rng = np.random.default_rng(3)
    drawn = drawn_effects(rng).effects
    vehicle = replace(with_lag(PLAIN, 0.03), effects={name: drawn[name]} if name else {})
    plant = make_plant(vehicle, 0.002)
    theirs = multirotor.Multirotor(rotorpy_parameters(vehicle))
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


def test_the_vehicle_as_flown_has_rotorpys_force_and_torque_in_every_motion():
    from rotorpy.vehicles import multirotor

    rng = np.random.default_rng(4)
    moved = with_effects(VEHICLE, com_offset=((0.01, 0.0, 0.02),), inflow=(1e-4,))
    plant = make_plant(as_flown(moved), 0.002)
    theirs = multirotor.Multirotor(rotorpy_parameters(moved))
    for _ in range(5):
        (vel_b, rate_b), speed = rng.normal(0, 6, (2, 3)), rng.uniform(300, 2000, 4)
        motion = Motion(np.zeros(3), np.eye(3), vel_b, rate_b)
        _, flow = wind_and_flow(plant, {}, motion, steady(speed), 0.0)
        ours = wrench_on(plant, steady(speed), flow)
        force_b, torque_b = theirs.compute_body_wrench(rate_b, speed, vel_b)
        np.testing.assert_allclose(force_b, ours.force_b, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(torque_b, ours.torque_b, rtol=1e-9, atol=1e-9)


def test_a_drag_at_the_hubs_is_flown_as_it_is():
    vehicle = with_effects(with_lag(PLAIN, 0.03), hub_drag=(2e-5, 1e-4))
    assert differences(vehicle) == [] and as_flown(vehicle) is vehicle
    parameters = rotorpy_parameters(vehicle)
    assert (parameters["k_d"], parameters["k_z"]) == (2e-5, 1e-4)
    both = as_flown(
        replace(vehicle, effects={**vehicle.effects, **with_effects(inflow=(1e-5,)).effects})
    )
    assert dict(both.effects) == {"hub_drag": (2e-5, pytest.approx(1.1e-4))}

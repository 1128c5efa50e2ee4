"""Each effect against numbers worked by hand from its equation, and what all have in common."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from eval.effects import EFFECTS, weak_motor
from eval.effects.log_faults import apply_log_faults
from eval.quadrotor.plant import Command, Motion, accelerations, make_plant, uses_noise
from eval.quadrotor.stepper import Inputs, hover_state, plant_step
from tests.support.flights import small_log
from tests.support.marks import more
from tests.support.vehicles import PLAIN, at_rest, with_effects
from tracks.geometry.rotation import quat_to_rot

# All four rotors at 1000 rad/s push 1.6 N each; their torques about z cancel.
SPEED = np.full(4, 1000.0)
MOVING = Motion(np.zeros(3), np.eye(3), np.array([3.0, -2.0, 1.0]), np.array([1.0, 2.0, -0.5]))
YAWED = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def wrench(vehicle, motion=MOVING, speed=SPEED, time_s=0.0, **more):
    plant = make_plant(vehicle, 0.002)
    inputs = Inputs(rotor_speed=speed, **more)
    _, acting = plant_step(plant, hover_state(plant, ()), motion, inputs, time_s)
    return acting


def added(motion=MOVING, speed=SPEED, **effects):
    """Return force and torque that effects add to those of the plain rotors."""
    plain = wrench(PLAIN, motion, speed)
    full = wrench(with_effects(**effects), motion, speed)
    return full.force_b - plain.force_b, full.torque_b - plain.torque_b


def near(actual, expected, tolerance=1e-9):
    np.testing.assert_allclose(actual, expected, rtol=1e-6, atol=tolerance)


def test_rotors_alone():
    force, torque = wrench(PLAIN)
    near(force, [0.0, 0.0, 6.4])
    near(torque, [0.0, 0.0, 0.0])
    # Rotor 1 alone, front right, counter-clockwise: rolls left, pitches up, yaws clockwise.
    force, torque = wrench(PLAIN, speed=FIRST)
    near(force, [0.0, 0.0, 1.6])
    near(torque, [-0.16, -0.12, -0.022])


UNEVEN, FIRST = np.array([1200.0, 1000.0, 1200.0, 1000.0]), np.array([1000.0, 0.0, 0.0, 0.0])
THIRD, NONE = np.array([1000.0, 1000.0, 1500.0, 1000.0]), [0.0, 0.0, 0.0]
ADDED = [
    ("linear_drag", ((0.3, 0.2, 0.1),), SPEED, [-0.675, 0.3, -0.075], NONE),
    # |v| = sqrt(14) = 3.7416574
    ("quadratic_drag", ((0.01, 0.02, 0.04),), SPEED, [-0.084187291, 0.112249722, -0.112249722],
     NONE),
    ("rotor_drag", (2e-5,), SPEED, [-0.24, 0.16, 0.0], NONE),
    # Each hub moves by w x r as well, which damps the rotation.
    ("hub_drag", (2e-5, 1e-4), SPEED, [-0.24, 0.16, -0.4], [-0.004, -0.0045, 0.000625]),
    ("hub_drag", (2e-5, 1e-4), THIRD, [-0.2705, 0.179625, -0.4625],
     [-0.01025, -0.0091875, 0.002203125]),
    ("translational_lift", (0.01,), SPEED, [0.0, 0.0, 0.0975], NONE),
    ("inflow", (1e-4,), SPEED, [0.0, 0.0, -0.4], NONE),
    # One rotor faster than the others loses more: rotor 3, rear left.
    ("inflow", (1e-4,), THIRD, [0.0, 0.0, -0.45], [-0.05 * 0.1, -0.05 * 0.075, 0.0]),
    # Rotor 1, front right, pushes a tenth less of its 1.6 N; its torque about z stays.
    ("thrust_scale", (0.9,), FIRST, [0.0, 0.0, -0.16], [0.016, 0.012, 0.0]),
    # Rotor 2 is rear right, clockwise: without its tenth the body rolls right and pitches up.
    ("weak_motor", ((1.0, 0.9, 1.0, 1.0),), SPEED, [0.0, 0.0, -0.16], [0.016, -0.012, -0.0022]),
    ("blade_flapping", (1e-6,), SPEED, NONE, [-0.008, -0.012, 0.0]),
    ("torque_trim", ((0.01, -0.02, 0.003),), SPEED, NONE, [0.01, -0.02, 0.003]),
    ("angular_damping", ((1.0, 2.0, 0.5),), SPEED, NONE, [-0.0025, -0.0084, 0.001075]),
    ("rotor_gyroscopic", (2e-5,), UNEVEN, NONE, [-0.016, 0.008, 0.0]),
    # Ahead of the rotors' centre the weight pitches the nose down (+y), on the left it rolls left.
    ("com_offset", ((0.01, 0.0, 0.0),), SPEED, NONE, [0.0, 0.064, 0.0]),
    ("com_offset", ((0.0, 0.01, 0.0),), SPEED, NONE, [-0.064, 0.0, 0.0]),
    ("com_offset", ((0.0, 0.0, 0.01),), SPEED, NONE, NONE),
    # From a hover to 1200 and 1000 rad/s in 2 ms the rotors turn by 400 rad/s more to the left than
    # to the right: against 400 / 0.002 x 1e-5 = 2 N m the body turns to the right.
    ("rotor_spin_up", (1e-5,), UNEVEN, NONE, [0.0, 0.0, -2.0]),
]  # fmt: skip
"""Effect, parameters, rotor speeds [rad/s], and force [N] and torque [N m] that are added."""


@pytest.mark.parametrize(("name", "parameters", "speed", "force_b", "torque_b"), ADDED)
def test_forces_and_torques_by_hand(name, parameters, speed, force_b, torque_b):
    found = added(speed=speed, **{name: parameters})
    near(found[0], force_b)
    near(found[1], torque_b)


def test_drags_take_the_true_mass():
    force = wrench(with_effects(linear_drag=((0.3, 0.2, 0.1),), mass_offset=(0.25,))).force_b
    near(force, [-0.9, 0.4, 6.3])


def test_ground_effect():
    """By g (r / 4 z)^2 = (0.0635 / 0.2)^2 = 0.10080625; at most 1.5, also on and below ground."""
    for height, push in ((0.05, 6.4 * (1 / 0.89919375 - 1)), (0.01, 3.2), (-0.2, 3.2)):
        near(added(at_rest(height), ground_effect=(1.0, 0.0635))[0], [0.0, 0.0, push])


def test_ground_effect_is_felt_by_each_rotor_at_its_own_height():
    angle = 0.3  # rolled right side down: left rotors are higher
    c, s = np.cos(angle), np.sin(angle)
    rolled = at_rest(0.1)._replace(rot_w=np.array([[1, 0, 0], [0, c, -s], [0, s, c]]))
    high, low = 0.1 + 0.1 * s, 0.1 - 0.1 * s
    more = [1.6 * (1 / (1 - (0.0635 / (4 * z)) ** 2) - 1) for z in (high, low)]
    force, torque = added(rolled, ground_effect=(1.0, 0.0635))
    near(force, [0.0, 0.0, 2 * sum(more)])
    near(torque, [2 * 0.1 * (more[0] - more[1]), 0.0, 0.0])


def test_constant_wind_acts_through_drag_only():
    near(added(constant_wind=((1.0, 0.0, 0.0),))[0], 0.0)
    # Gusts without random numbers are absent.
    near(added(gusts=(2.0, 4.0), linear_drag=((0.3, 0.2, 0.1),))[0], [-0.675, 0.3, -0.075])
    still = Motion(np.zeros(3), YAWED, np.zeros(3), np.zeros(3))
    wind: dict[str, Any] = {"constant_wind": ((1.0, 0.0, 0.5),), "linear_drag": ((0.3, 0.2, 0.1),)}
    # Facing world y, the wind along world x comes from the left and blows to the right.
    near(added(still, **wind)[0], [0.0, -0.15, 0.0375])


def test_gusts_have_their_intensity_colour_and_mean():
    vehicle = with_effects(gusts=(1.5, 4.0), linear_drag=((1.0, 1.0, 1.0),))
    plant = make_plant(vehicle, 0.02)
    assert uses_noise(plant)
    rng = np.random.default_rng(1)
    n, steps = 400, 200
    motion = Motion(
        np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)), np.tile([8.0, 0, 0], (n, 1)),
        np.zeros((n, 3)),
    )  # fmt: skip
    state = hover_state(plant, (n,), noise=rng.standard_normal((n, 3)))
    winds = []
    for _ in range(steps):
        inputs = Inputs(rotor_speed=np.tile(SPEED, (n, 1)), noise=rng.standard_normal((n, 3)))
        state, _ = plant_step(plant, state, motion, inputs, 0.0)
        winds.append(state.wind["gusts"])
    winds = np.array(winds)
    np.testing.assert_allclose(winds.std(axis=(0, 1)), [1.5, 1.5, 0.75], rtol=0.05)
    np.testing.assert_allclose(winds.mean(axis=(0, 1)), 0.0, atol=0.08)
    # At 8 m/s of airspeed the wind of 4 m length forgets itself in 0.5 s, here 25 steps.
    kept = (winds[25:] * winds[:-25]).mean(axis=(0, 1)) / (winds**2).mean(axis=(0, 1))
    np.testing.assert_allclose(kept, np.exp(-1.0), atol=0.05)


def test_motor_lag_replaces_the_time_constant():
    plant = make_plant(with_effects(motor_lag=(0.05,)), 0.05)
    state = hover_state(plant, ())._replace(rotor_speed=SPEED)
    # 6.25 N over four rotors of k_T asks for the speed that gives it.
    wanted = 2000.0
    command = Command(np.array(4 * 1.6e-6 * wanted**2 / 0.75), np.zeros(3))
    state, _ = plant_step(plant, state, at_rest(), Inputs(command), 0.0)
    near(state.rotor_speed, 1000.0 + 1000.0 * (1.0 - np.exp(-1.0)))


@pytest.mark.parametrize(
    ("delay", "thrusts", "acting"),
    [
        (0.0, [15.0] * 3, [15.0] * 3),
        (0.03, [15.0] * 18, [9.81] * 15 + [15.0] * 3),
        # Between two steps: the mean over the step.
        (0.005, [10.0, 20.0, 12.0, 12.0, 12.0], [9.81, 9.81, (9.81 + 10.0) / 2, 15.0, 16.0]),
    ],
)
def test_command_delay(delay, thrusts, acting):
    plant = make_plant(with_effects(command_delay=(delay,)), 0.002)
    state, pushes = hover_state(plant, ()), []
    for thrust in thrusts:
        inputs = Inputs(Command(np.array(thrust), np.zeros(3)))
        state, wrench = plant_step(plant, state, at_rest(), inputs, 0.0)
        pushes.append(wrench.force_b[2] / 0.75)
    near(pushes, acting)


def test_battery_sag():
    near(wrench(with_effects(battery_sag=(0.001, 0.0)), time_s=50.0).force_b[2], 6.4 * 0.95)
    by_voltage = with_effects(battery_sag=(0.001, 0.05))
    near(wrench(by_voltage, time_s=50.0, voltage_drop=np.array(2.0)).force_b[2], 6.4 * 0.9)
    # A judge without voltage goes by time.
    near(wrench(by_voltage, time_s=50.0).force_b[2], 6.4 * 0.95)


def test_mass_offset_inertia_scale_and_rate_gain():
    start, command = at_rest(), Command(np.array(9.81), np.array([1.0, -1.0, 0.5]))
    cases: list[tuple[dict[str, Any], float, list[float]]] = [
        ({}, 0.0, [20.0, -20.0, 4.0]),
        ({"mass_offset": (0.1,)}, 9.81 * 0.75 / 0.85 - 9.81, [20.0, -20.0, 4.0]),
        ({"inertia_scale": ((0.8, 1.25, 2.0),)}, 0.0, [25.0, -16.0, 2.0]),
        ({"rate_gain": ((0.5, 1.5, 2.0),)}, 0.0, [10.0, -30.0, 8.0]),
    ]
    for effects, climb, turn in cases:
        plant = make_plant(with_effects(**effects), 0.002)
        _, acting = plant_step(plant, hover_state(plant, ()), start, Inputs(command), 0.0)
        found = accelerations(plant, start, acting)
        near(found[0], [0.0, 0.0, climb])
        near(found[1], turn)


def test_gyroscopic_terms_of_the_true_inertia():
    plant = make_plant(with_effects(inertia_scale=((2.0, 1.0, 1.0),)), 0.002)
    none = wrench(PLAIN)._replace(torque_b=np.zeros(3))
    # J w = (0.005, 0.0042, -0.00215); -w x J w = (0.0022, 0.00035, 0.0058) by hand.
    near(accelerations(plant, MOVING, none)[1], [0.0022 / 0.005, 0.00035 / 0.0021, 0.0058 / 0.0043])


def test_rotors_that_turn_as_their_command_says_push_nothing_by_spinning_up():
    hover, spinning = Command(np.asarray(9.81), np.zeros(3)), with_effects(rotor_spin_up=(1e-5,))
    near(wrench(spinning, at_rest(), None, command=hover).torque_b, 0.0)


def test_weak_motors_are_written_by_their_numbers():
    for scale, table in (
        ((1.0, 1.0, 0.9, 1.0), {"index": 3, "scale": 0.9}),
        ((0.8, 1.0, 1.0, 0.9), {"index": [1, 4], "scale": [0.8, 0.9]}),
        ((1.0, 1.0, 1.0, 1.0), {"index": 1, "scale": 1.0}),
    ):
        assert weak_motor.write(weak_motor.WeakMotor(scale)) == table
        assert weak_motor.read(table) == weak_motor.WeakMotor(scale)


def test_thrust_tilt():
    force, torque = added(thrust_tilt=((0.01, 0.02),))
    near(force, [6.4 * 0.02, -6.4 * 0.01, -6.4 * 0.00025], tolerance=1e-4)
    near(torque, 0.0)


def test_slung_load():
    # Of a vehicle in hover it hangs straight down, and pulls by its weight.
    near(added(slung_load=(0.05, 0.5))[0], [0.0, 0.0, -0.05 * 9.81])
    near(added(slung_load=(0.05, 0.5))[1], 0.0)
    # In a body on its side, "down" is another axis.
    side = MOVING._replace(rot_w=np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    near(added(side, slung_load=(0.05, 0.5))[0], [0.0, -0.05 * 9.81, 0.0])


def test_frame_tilt():
    plant = make_plant(with_effects(frame_tilt=((0.01, 0.02),)), 0.002)
    gravity = plant.constants.gravity_w
    near(gravity, [-0.1962, 0.0981, -9.81 + 0.00245], tolerance=2e-4)
    near(np.linalg.norm(gravity), 9.81)


def test_sensor_biases():
    log = small_log()
    vehicle = with_effects(gyro_bias=((0.1, 0.0, -0.2),), accelerometer_bias=((0.0, 0.5, 0.0),))
    faulty = apply_log_faults(vehicle.effects, log)
    near(faulty["rate_b"][2], [0.1, 0.0, 0.8])
    near(faulty["acc_b"][2], [0.0, 0.5, 9.81])
    assert faulty["pos_w"] is log["pos_w"]
    assert "acc_b" not in apply_log_faults(vehicle.effects, {"time_s": log["time_s"]})


def test_lever_arm_logs_another_point():
    # Heading along world y: body x is along world y, and body y along -x. It yaws by 2 rad/s.
    log = small_log() | {"quat_wxyz": np.tile([0.5**0.5, 0.0, 0.0, 0.5**0.5], (5, 1))}
    log["rate_b"] = np.tile([0.0, 0.0, 2.0], (5, 1))
    faulty = apply_log_faults(with_effects(lever_arm=((0.1, 0.0, 0.05),)).effects, log)
    near(faulty["pos_w"] - log["pos_w"], np.tile([0.0, 0.1, 0.05], (5, 1)))
    near(faulty["vel_w"] - log["vel_w"], np.tile([-0.2, 0.0, 0.0], (5, 1)))
    for name in ("quat_wxyz", "rate_b", "acc_b"):
        assert faulty[name] is log[name]


def test_attitude_offset_logs_other_body_axes():
    # The tracker's x axis points to the left of the vehicle's.
    log, quarter = small_log(), (0.0, 0.0, 0.5 * np.pi)
    faulty = apply_log_faults(with_effects(attitude_offset=(quarter,)).effects, log)
    near(quat_to_rot(faulty["quat_wxyz"])[0], [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for name in ("pos_w", "vel_w", "rate_b", "acc_b"):
        assert faulty[name] is log[name]


@pytest.mark.parametrize("xp", [np, more(jnp)])
def test_clock_offset_logs_an_older_pose(xp):
    log = {name: xp.asarray(values) for name, values in small_log().items()}
    faulty = apply_log_faults(with_effects(clock_offset=(0.015,)).effects, log)
    np.testing.assert_allclose(faulty["pos_w"][:, 0], 3.0 * (log["time_s"] - 0.015), atol=1e-6)
    np.testing.assert_allclose(faulty["vel_w"][4, 0], 3.05, rtol=1e-6)
    quat = np.asarray(faulty["quat_wxyz"])
    np.testing.assert_allclose(np.linalg.norm(quat, axis=-1), 1.0, rtol=1e-6)
    turned = np.tan(0.5 * (small_log()["time_s"] - 0.015))
    np.testing.assert_allclose(quat[:, 3] / quat[:, 0], turned, atol=1e-5)
    for name in ("rate_b", "acc_b", "thrust_cmd", "time_s"):
        assert faulty[name] is log[name]


def test_every_effect_of_the_catalogue_has_its_own_test():
    source = Path(__file__).read_text(encoding="utf-8")
    forms = "{}=(", '"{}": (', '("{}", ('
    by_hand = [name for name in EFFECTS if any(form.format(name) in source for form in forms)]
    assert by_hand == list(EFFECTS)

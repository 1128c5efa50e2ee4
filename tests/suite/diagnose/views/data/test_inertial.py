"""Flights without a pose: velocity, drag and thrust by gyro, accelerometer and rotor speeds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval.logs.flight_log import FlightLog
from eval.quadrotor.vehicle_file import load_vehicle
from suite.diagnose.data.flights import completed, ready
from suite.diagnose.data.inertial import posed
from suite.diagnose.data.view import SPECIFIC, TORQUE
from suite.diagnose.estimate.parameters import make_space
from suite.diagnose.evidence.moments import ForceModel
from suite.diagnose.evidence.views import ViewEvidence
from suite.diagnose.identify.identify import identify
from tests.support.diagnosis_flights import fly
from tests.support.real_flights import VEHICLE

DRAG = 0.4


def flown(seed=0, end_s=10.0, bias=1.0, speed=1.0, gyro_walk=0.0, acc_noise=0.2):
    """Return a flight from rest under a drag, its velocity and attitude.

    `speed` scales the path; `gyro_walk` is the deviation of a gyro error held for 0.1 s [rad/s].
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, end_s, 0.01)
    phase = 2.0 * np.pi * (np.array([0.21, 0.17, 0.13]) + 0.02 * seed) * time_s[:, None]
    vel_w = np.array([4.0, 3.0, 1.0]) * np.sin(phase) ** 2 * np.tanh(time_s)[:, None]
    vel_w = speed * vel_w
    force_w = np.gradient(vel_w, time_s, axis=0) + [0.0, 0.0, 9.81] + DRAG * vel_w
    thrust = np.linalg.norm(force_w, axis=1)
    up = force_w / thrust[:, None]
    left = np.cross(up, [1.0, 0.0, 0.0])
    left /= np.linalg.norm(left, axis=1)[:, None]
    rot = Rotation.from_matrix(np.stack([np.cross(left, up), left, up], axis=-1))
    turns = (rot[:-1].inv() * rot[1:]).as_rotvec() / 0.01
    rate_b = np.concatenate([turns[:1], 0.5 * (turns[1:] + turns[:-1]), turns[-1:]])
    acc_b = rot.inv().apply(force_w - DRAG * vel_w)
    rate_b = rate_b + bias * 0.005 * rng.normal(size=3) + 0.02 * rng.normal(size=rate_b.shape)
    slow = np.repeat(rng.normal(size=(len(time_s) // 10 + 1, 3)), 10, axis=0)[: len(time_s)]
    rate_b = rate_b + gyro_walk * slow
    acc_b = acc_b + bias * 0.05 * rng.normal(size=3) + acc_noise * rng.normal(size=acc_b.shape)
    each = np.sqrt(VEHICLE.mass * thrust / 4.0 / VEHICLE.rotors.thrust_coefficient)
    lost = np.full((len(time_s), 4), np.nan)
    log = FlightLog(
        f"flight {seed}", time_s, lost[:, :3], lost, lost[:, :3], rate_b, acc_b=acc_b,
        rotor_speed=each[:, None] + rng.normal(size=(len(time_s), 4)),
        about={"partial": ["pos", "quat"]}, velocity_derived=True,
    )  # fmt: skip
    return log, vel_w, rot


@pytest.mark.parametrize("end_s", [10.0, 40.0])
def test_gyro_and_accelerometer_give_the_velocity(end_s):
    log, vel_w, rot = flown(end_s=end_s)
    (found,) = posed([log])
    off = found.vel_w - vel_w
    assert np.sqrt((off**2).mean()) < 0.3
    lean = (rot.as_matrix()[:, :, 2] * found.rot_w[:, :, 2]).sum(axis=1)
    assert np.degrees(np.arccos(np.clip(lean, -1.0, 1.0))).mean() < 2.0
    assert found.pose_slope_b is not None and found.pose_slope_b.shape[:2] == (len(off), 3)


def test_a_flight_may_begin_on_its_side():
    log = flown(end_s=2.0)[0]
    about_y = Rotation.from_euler("y", 90.0, degrees=True)
    turned = {"rate_b": about_y.apply(log.rate_b), "acc_b": about_y.apply(log.acc_b)}
    (found,) = posed([replace(log, **turned)])
    force_w = (found.rot_w[0] @ turned["acc_b"][:10].mean(axis=0)) / 9.81
    assert force_w == pytest.approx([0.0, 0.0, 1.0], abs=0.1)


def test_thrust_and_drag_are_identified_without_a_pose():
    found = identify([flown(seed, 6.0)[0] for seed in range(3)], VEHICLE)
    numbers = {number.key: number for number in found.numbers}
    thrust = numbers["rotors.thrust_coefficient"].value[0]
    assert thrust == pytest.approx(VEHICLE.rotors.thrust_coefficient, rel=0.01)
    drag = numbers["effects.linear_drag.coefficient"].value
    assert drag == pytest.approx([DRAG] * 3, abs=0.05)
    assert any("heading" in line for line in found.not_identified)


@pytest.mark.slow
def test_a_drag_of_slow_flights_is_identified_where_the_gyro_drifts_and_of_a_hover_not():
    """As in logs whose gyro was sampled too rarely: the tilt drifts by 0.03 rad a second."""
    slow = {"end_s": 30.0, "speed": 0.3, "gyro_walk": 0.1, "acc_noise": 0.05}
    found = identify([flown(seed, **slow)[0] for seed in range(3)], VEHICLE)
    drag = next(n for n in found.numbers if n.key == "effects.linear_drag.coefficient")
    spans = [span for span in drag.ci95[:2] if span is not None]
    assert spans and all(low < DRAG < high for low, high in spans)
    still = {"end_s": 10.0, "speed": 0.003, "gyro_walk": 0.1}
    found = identify([flown(seed, **still)[0] for seed in range(3)], VEHICLE)
    drag = [span for n in found.numbers if "linear_drag" in n.key for span in n.ci95[:2]]
    assert not any(drag), drag


def test_views_are_of_what_a_log_has():
    log = flown()[0]
    assert [view.about for view in ready([log], VEHICLE).views] == [SPECIFIC.about, TORQUE.about]
    assert ready([replace(log, acc_b=None)], VEHICLE).views == (TORQUE,)
    without = replace(log, about={"partial": ["pos", "quat", "rate"]})
    with pytest.raises(ValueError, match="no position and no gyro"):
        completed(without)
    thrust = replace(log, acc_b=None, rotor_speed=None, thrust_cmd=np.full(len(log.time_s), 9.81))
    with pytest.raises(ValueError, match="no accelerometer or no motor"):
        ready([thrust], VEHICLE)


def test_a_rate_loop_faster_than_the_log_does_not_look_like_inertia():
    vehicle = load_vehicle("reference")
    log = fly(vehicle, 0, duration_s=4.0, noise=0.0, motors=True)
    space = make_space(vehicle)
    model, smoothed = ForceModel(vehicle, space, voltage=False), ready([log], vehicle).smoothed
    data = ViewEvidence(TORQUE, model, smoothed[TORQUE.name]).residuals(space.array("start"))
    share = (data.value * data.residual).sum(axis=0) / (data.value**2).sum(axis=0)
    assert share == pytest.approx([0.0] * 3, abs=0.0015)

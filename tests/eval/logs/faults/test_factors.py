"""Factors, axes and motor maps: corrected where they have a name."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from eval.logs.faults.drive.commands import check_thrust_command
from eval.logs.faults.drive.motors import check_inertia, check_lift, check_motors, fit_force
from eval.logs.faults.reading import parse_readings, read_rows
from eval.logs.faults.relation import match
from eval.logs.faults.vectors import check_gyro, check_velocity
from eval.logs.faults.vehicle import check_vehicle_numbers, vehicle_doubts
from eval.quadrotor.loops import KINDS
from eval.quadrotor.vehicle_file import load_vehicle, shipped_vehicles
from eval.vehicles.vehicle import CollisionBox, Controller, MotorMap
from tests.support import known_flight
from tests.support.vehicles import PLAIN

FIRMWARE = KINDS["betaflight"].Settings(p_roll=0.45)
SCALED = Controller(PLAIN.controller.rate_gain, 500.0, kind="betaflight", settings=FIRMWARE)
DEGREES = replace(PLAIN.controller, rate_max=(180.0, 180.0, 90.0))
"""A firmware's loop with a gain in another unit."""
HOVER = np.sqrt(PLAIN.mass * 9.81 / (4 * PLAIN.rotors.thrust_coefficient))


def lift(factor, vehicle=PLAIN, **force):
    rows = {"motor": np.full((50, 4), HOVER * factor), "time": np.arange(50.0)}
    (finding,) = check_lift(rows | (force or {"acc": np.tile([0.0, 0.0, 9.81], (50, 1))}), vehicle)
    return finding


def test_speeds_that_carry_the_weight_or_what_an_effect_or_turns_can_do_are_no_fault():
    assert lift(0.98).status == lift(1.03).status == lift(1.0, pwm=HOVER).status == "ok"
    assert (lift(1.1).status, lift(1.1).fault) == ("note", "thrust_scale")
    assert {lift(one, pwm=HOVER).status for one in (1.16, 14 / 12, 1.4)} == {"not identifiable"}
    assert lift(6.0, pwm=HOVER).status == "corrected" and lift(0.7, pwm=HOVER).is_open


@pytest.mark.parametrize("seed", range(3))
def test_the_lift_of_a_short_fast_noisy_flight_is_right(seed):
    fine_s = np.arange(0.0, 6.0, 0.001)
    roll, thrust = 0.8 * np.sin(8.0 * fine_s), 12.0 + 3.0 * np.sin(5.0 * fine_s)
    none = np.zeros_like(roll)
    acc_w = thrust * np.stack([none, -np.sin(roll), np.cos(roll)]) - [[0.0], [0.0], [9.81]]
    pos_w = np.cumsum(np.cumsum(acc_w, axis=1), axis=1) * 0.001**2
    quat = np.stack([np.cos(roll / 2), np.sin(roll / 2), none, none])
    rows = {"time": fine_s, "pos": pos_w.T, "quat": quat.T, "thrust": thrust}
    rows = {name: values[::10] for name, values in rows.items()}
    rows["pos"] += 0.005 * np.random.default_rng(seed).standard_normal(rows["pos"].shape)
    assert fit_force(rows, 2.0 * rows.pop("thrust"))[1] == pytest.approx(2.0, rel=0.01)


def test_a_factor_with_a_name_is_put_right():
    rpm = 60 / (2 * np.pi)
    for factor, words, scale in ((6.0, "6 pole", 6.0), (rpm, "rpm", rpm), (7.1, "7 pole", 7.0)):
        finding = lift(factor)
        assert finding.status == "corrected" and words in finding.evidence
        assert finding.fix == f"--read motor={1 / scale:.10g}"
        assert "or --vehicle is another vehicle's file, or its rotors.thr" in finding.evidence


@pytest.mark.parametrize("factor", [6.5, 11.0, 11.5, 10.2])
def test_a_factor_between_two_names_is_left_to_its_owner(factor):
    """By either the speeds would look well; the wrong one would be off by a sixth or less."""
    finding = lift(factor)
    assert finding.is_open and " or " in finding.evidence


def test_a_factor_without_a_name_is_a_doubt():
    assert lift(2.5).is_open and "the --vehicle of this log" in lift(2.5).fix
    assert lift(1.0, None).status == "note"
    assert lift(14 / 12).fault == "motor_poles" and "14" in lift(14 / 12).fix
    assert "the --vehicle of this log" in lift(14 / 12).fix
    assert lift(5**-0.5).fault == "vehicle_mass"


@pytest.mark.parametrize(("axes", "both"), [("y,-x,z", True), ("y,x,z", False), ("x,-y,z", False)])
def test_axes_of_a_gyro_that_are_a_rotation_may_be_those_of_the_attitude(axes, both):
    parts = known_flight.fly(np.arange(0.0, 10.0, 0.01))
    rows = {"time": parts.time, "quat": parts.quat, "rate": parts.rate}
    found = check_gyro(read_rows(rows, parse_readings([f"rate={axes}"])))
    (turned,) = (f for f in found if f.fault == "gyro_axes" and f.status == "corrected")
    assert ("or the attitude's body is rotated" in turned.evidence) == both


def test_without_a_gyro_order_and_spin_are_not_identifiable():
    found = check_motors({"motor": np.full((50, 4), HOVER), "time": np.arange(50.0)}, PLAIN)
    assert [(one.fault, one.status) for one in found] == [
        (fault, "not identifiable") for fault in ("motor_order", "motor_spin")
    ]


@pytest.mark.parametrize(
    ("factor", "named"), [(1.0, False), (2.0, False), (10.0, True), (0.1, True)]
)
def test_an_inertia_that_the_turns_exclude_is_doubted(factor, named):
    parts = known_flight.fly(np.arange(0.0, 10.0, 0.01))
    rows = {name: getattr(parts, name) for name in ("time", "pos", "quat", "rate", "motor")}
    wrong = replace(PLAIN, inertia=tuple(factor * moment for moment in PLAIN.inertia))
    found, named = check_inertia(rows, wrong), factor in (10.0, 0.1)
    assert [(one.fault, one.is_open) for one in found] == [("vehicle_inertia", True)] * named
    assert not named or found[0].size == pytest.approx(factor, rel=0.15)
    assert check_inertia({k: v for k, v in rows.items() if k != "quat"}, wrong) == []
    # A radius of gyration beyond the rotors is implausible without flights.
    assert {one.fault for one in check_vehicle_numbers(wrong)} == (
        {"vehicle_inertia"} if factor == 10.0 else {""}
    )


ARMS = [(100, 1, "100"), (1000, 1, "1000"), (1000, 0.05, "100 or 1000")]


@pytest.mark.parametrize(("unit", "inertia", "divisor"), ARMS)
def test_arms_in_cm_or_mm_are_converted_by_what_fits_the_inertia(unit, inertia, divisor):
    hubs = tuple((unit * x, unit * y, unit * z) for x, y, z in PLAIN.rotors.position)
    moments = tuple(inertia * moment for moment in PLAIN.inertia)
    wrong = replace(PLAIN, inertia=moments, rotors=replace(PLAIN.rotors, position=hubs))
    finding, *_ = check_vehicle_numbers(wrong)
    assert finding.fault == "vehicle_arms"
    assert finding.fix == f"rotors.position in m: divide by {divisor}"


@pytest.mark.parametrize(
    ("torque", "gain", "fault", "fix"),
    [
        (0.01375, (20.0, 20.0, 8.0), "vehicle_torque", "torque_coefficient = KM * thrust"),
        (2.2e-12, (20.0, 20.0, 8.0), "vehicle_torque", "in N m/(rad/s)^2"),
        (2.2e-8, (0.15, 0.15, 0.2), "vehicle_gain", "angular acceleration for each rad/s"),
    ],
)
def test_numbers_copied_from_a_firmware_are_doubted(torque, gain, fault, fix):
    rotors = replace(PLAIN.rotors, torque_coefficient=torque)
    wrong = replace(PLAIN, rotors=rotors, controller=replace(PLAIN.controller, rate_gain=gain))
    (finding,) = check_vehicle_numbers(wrong)
    assert finding.fault == fault and fix in finding.fix


@pytest.mark.parametrize(
    ("changes", "fault", "fix"),
    [
        ({"body": CollisionBox((64.0, 64.0, 25.0))}, "vehicle_arms", "divide by 1000"),
        ({"camera": replace(PLAIN.camera, fov_deg=(1.37, 1.11))}, "camera_fov", "not radians"),
        ({"motors": MotorMap((0.0, 100.0), 16.0)}, "motor_map", "in N, of one motor"),
        ({"controller": SCALED}, "vehicle_gain", "the firmware's own tool"),
        ({"controller": DEGREES}, "vehicle_gain", "in rad/s, not deg/s"),
    ],
)
def test_values_of_simulated_flights_are_doubted_and_stop_no_diagnosis(changes, fault, fix):
    (finding,) = check_vehicle_numbers(replace(PLAIN, **changes))
    assert (finding.fault, finding.is_open) == (fault, False) and fix in finding.fix
    (sentence,) = vehicle_doubts(replace(PLAIN, **changes))
    assert fix in sentence


def test_shipped_vehicles_and_examples_are_not_doubted():
    for vehicle in (*shipped_vehicles(), *Path("examples").glob("*.toml")):
        assert not vehicle_doubts(load_vehicle(vehicle)), vehicle


def thrust(factor, vehicle=PLAIN):
    time_s = np.arange(0.0, 4.0, 0.01)
    force = 9.81 + 2.0 * np.sin(3.0 * time_s)
    acc = np.column_stack([np.zeros_like(force), np.zeros_like(force), force])
    rows = {"time": time_s, "acc": acc, "cmd_thrust": factor * force[:, None]}
    return check_thrust_command(rows, vehicle)


def test_a_command_near_the_force_is_fine():
    for factor in (1.0, 0.88, 1.3):
        (finding,) = thrust(factor)
        assert finding.status == "ok", factor


def test_a_unit_or_a_sign_of_the_thrust_is_corrected():
    for factor, fix in (
        (1 / 9.81, 9.81), (0.92 / 9.81, 9.81), (-1.0, -1), (-1 / 9.81, -9.81), (-0.67, -1),
        (-1.6, -1),
    ):  # fmt: skip
        (finding,) = thrust(factor)
        assert (finding.status, finding.fix) == ("corrected", f"--read cmd_thrust={fix}")


def test_newtons_need_the_mass_and_a_share_of_full_thrust_has_no_unit():
    heavy = replace(PLAIN, mass=4.0)
    (finding,) = thrust(4.0, heavy)
    assert "newtons" in finding.evidence and finding.fix == "--read cmd_thrust=0.25"
    light = replace(PLAIN, mass=0.78)
    for factor in (0.78, 0.84):
        (finding,) = thrust(factor, light)
        assert finding.fault == "thrust_command_unit" and not finding.is_open, "or thrust is lower"
    (finding,) = thrust(4.0, None)
    assert finding.is_open and finding.fault == "thrust_command_unit"
    (finding,) = thrust(0.67)
    assert (finding.status, finding.fault) == ("note", "thrust_scale"), "the mass may be 0.5 kg"
    (finding,) = thrust(0.03)
    assert finding.is_open and "share of full thrust" in finding.evidence


def findings(vel_of, seed=0):
    """Return findings on a flight to and fro along a straight line, with noise."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, 10.0, 0.01)
    along = np.array([0.7, -1.65, 0.05])
    pos = np.sin(0.8 * time_s)[:, None] * along
    vel = vel_of(0.8 * np.cos(0.8 * time_s)[:, None] * along)
    noise = rng.standard_normal((2, len(time_s), 3))
    rows = {"time": time_s, "pos": pos + 0.003 * noise[0], "vel": vel + 0.03 * noise[1]}
    return {one.fault: one for one in check_velocity(rows) if one.fault}


@pytest.mark.parametrize("seed", range(3))
def test_on_a_straight_line_no_axis_is_taken_for_another(seed):
    """There x and y are proportional, and y over x is no unit."""
    assert "velocity_unit" not in findings(lambda vel: vel, seed)


def test_another_unit_on_a_straight_line_is_found():
    found = findings(lambda vel: 100.0 * vel)["velocity_unit"]
    assert found.status == "corrected" and "cm/s" in found.evidence


def test_axes_that_move_in_proportion_are_no_evidence_of_their_order():
    found = findings(lambda vel: vel)
    assert found["velocity_frame"].status == "not identifiable"
    assert "y,x,z" in found["velocity_frame"].evidence


def test_swapped_axes_are_found_though_they_resemble_each_other():
    rng = np.random.default_rng(5)
    first, other, weak = rng.standard_normal((3, 500))
    wanted = np.column_stack([first, 0.6 * first + 0.8 * other, 0.02 * weak])
    given = wanted[:, [1, 0, 2]] + 0.015 * rng.standard_normal(wanted.shape)
    found = match(wanted, given)
    assert (found.axes, found.rival) == ("y,x,z", "") and found.is_turned
    assert not match(wanted, wanted).is_turned


@pytest.mark.parametrize(("factor", "status"), [(57.3, "doubt"), (1.0, "not identifiable")])
def test_rates_that_no_gyro_measures_are_a_fault_without_an_attitude(factor, status):
    time_s = np.arange(0.0, 10.0, 0.01)
    rate = factor * np.column_stack([3.0 * np.sin(time_s), np.cos(2.0 * time_s), 0.1 * time_s])
    found = {one.fault: one.status for one in check_gyro({"time": time_s, "rate": rate})}
    assert found["gyro_scale"] == status


@pytest.mark.parametrize("late", ["vel", "pos"])
def test_a_velocity_that_is_late_against_the_path_is_doubted(late):
    """A low pass of the first order with a time constant of 60 ms."""
    truth = known_flight.fly(np.arange(0.0, 10.0, 0.01))
    rows = {"time": truth.time, "pos": truth.pos, "vel": truth.vel, "quat": truth.quat}
    assert "velocity_delay" not in {finding.fault for finding in check_velocity(rows)}
    rows[late] = lfilter([1 / 7], [1.0, -6 / 7], rows[late], axis=0)
    (found,) = (one for one in check_velocity(rows) if one.fault == "velocity_delay")
    assert found.signal == {"vel": "velocity", "pos": "position"}[late]
    assert found.is_open == (late == "vel")
    assert abs(found.size) == pytest.approx(0.06, abs=0.015)

"""Delay and heading of a position against the attitude."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval.effects.interface import GRAVITY
from eval.logs.faults.check import CheckContext, check_log
from eval.logs.faults.clocks import path
from eval.logs.faults.clocks.path import check_position_delay
from eval.logs.faults.heading import check_heading
from eval.logs.faults.pose import axes_of
from tests.support.diagnosis_flights import fly, without_fault
from tests.support.marks import more
from tests.support.vehicles import PLAIN, with_effects


@pytest.fixture(scope="module")
def log():
    return replace(without_fault(), rotor_speed=None)


def shifted(log, late_s, names=("pos_w", "vel_w")):
    """Return the log with the signals `names` of `late_s` before."""
    time_s = log.time_s - late_s
    moved = {
        name: np.stack([np.interp(time_s, log.time_s, x) for x in getattr(log, name).T], axis=1)
        for name in names
    }
    if "quat_wxyz" in moved:
        moved["quat_wxyz"] /= np.linalg.norm(moved["quat_wxyz"], axis=1, keepdims=True)
    return replace(log, **moved)


def findings(log):
    found, _ = check_log(log, CheckContext(PLAIN))
    open_ones = [finding for finding in found if finding.is_open]
    return open_ones, [f for f in found if "position delay" in (f.signal, f.fault)]


@pytest.mark.parametrize("late_s", [-0.4, more(0.06), 0.2])
def test_a_late_position_and_a_set_point_are_the_only_finding(log, late_s):
    (found,), _ = findings(shifted(log, late_s))
    assert found.fault == "position_delay" and found.size == pytest.approx(late_s, abs=0.005)
    words = "early against the attitude, as a set point" if late_s < 0.0 else "late against the att"
    assert words in found.evidence
    assert found.fix.startswith("give the measured" if late_s < 0.0 else "stamp positions")


@pytest.mark.parametrize(
    ("names", "late_s", "fault", "evidence"),
    [
        (("vel_w",), -0.2, "velocity_delay", "as a set point is"),
        more(("vel_w",), 0.2, "velocity_delay", "late against the path"),
        (("quat_wxyz",), -0.1, "attitude", "early against path and gyro, as a set point is"),
        (("pos_w", "vel_w", "quat_wxyz"), 0.3, "clock_offset", "late against the gyro"),
        (("rate_b",), 0.2, "clock_offset", "late against the attitude"),
    ],
)
def test_set_points_and_late_signals_are_the_only_finding(log, names, late_s, fault, evidence):
    (found,), _ = findings(shifted(log, late_s, names))
    assert found.fault == fault and evidence in found.evidence
    assert abs(found.size) == pytest.approx(abs(late_s), abs=0.005)


@pytest.mark.parametrize("name", ["quat_wxyz", more("rate_b")])
def test_rows_without_a_value_do_not_hide_that_the_attitude_is_a_set_point(log, name):
    early = shifted(log, -0.1, ("quat_wxyz",))
    values = getattr(early, name).copy()
    values[:30] = np.nan
    (found,), _ = findings(replace(early, **{name: values}))
    assert found.fault == "attitude" and found.size == pytest.approx(0.1, abs=0.005)


def test_a_late_pose_is_no_fault_if_the_vehicle_file_states_the_delay(log):
    late, stated = shifted(log, 0.1, ("pos_w", "vel_w", "quat_wxyz")), []
    for flight, offset_s in ((late, 0.1), (late, 0.03), (log, 0.1)):
        vehicle = with_effects(PLAIN, clock_offset=(offset_s,))
        stated.append([f for f in check_log(flight, CheckContext(vehicle))[0] if f.is_open])
    assert stated[0] == []
    for (found,), size_s in zip(stated[1:], (0.1, 0.0), strict=True):
        assert found.fault == "clock_offset" and found.size == pytest.approx(size_s, abs=0.005)
        assert "clock_offset of the vehicle file: " in found.evidence


def test_a_position_in_time_and_wrong_axes_are_no_delay(log):
    opened, (fine,) = findings(log)
    assert not opened and fine.status == "ok"
    assert findings(shifted(log, 0.03))[0] == []
    swapped = replace(log, pos_w=log.pos_w[:, [1, 0, 2]], vel_w=log.vel_w[:, [1, 0, 2]])
    assert "position_delay" not in {finding.fault for finding in findings(swapped)[0]}


def circling(speed, radius_m, spacing_s, drag=0.4):
    """Return rows of a circle, the nose along the path and the speed changing by a third."""
    time_s = np.arange(0.0, 10.0, spacing_s)
    turn = speed / radius_m
    angle = turn * time_s + np.sin(turn * time_s) / 3.0
    pos = radius_m * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    vel = np.gradient(pos, time_s, axis=0)
    up = np.gradient(vel, time_s, axis=0) + drag * vel + [0.0, 0.0, GRAVITY]
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    left = np.cross(up, vel)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    axes = np.stack([np.cross(left, up), left, up], axis=-1)
    quat = Rotation.from_matrix(axes).as_quat(scalar_first=True)
    return {"time": time_s, "pos": pos, "quat": quat}


def test_the_drag_of_a_fast_flight_forwards_is_no_delay():
    (found,) = check_position_delay(circling(7.0, 5.0, 0.0025))
    assert found.status == "ok"


def test_a_delay_that_fits_hardly_better_than_none_is_not_identifiable(monkeypatch):
    rows = circling(7.0, 5.0, 0.0025)
    late = rows | {"pos": np.roll(rows["pos"], 40, axis=0)}
    (found,) = check_position_delay(late)
    assert found.fault == "position_delay" and found.size == pytest.approx(0.1, abs=0.005)
    monkeypatch.setattr(path, "CLEARER", 0.0)
    (unclear,), (fine,) = (check_position_delay(one) for one in (late, rows))
    assert (unclear.status, fine.status) == ("not identifiable", "ok")


def test_noise_is_as_large_at_every_delay_that_is_tried(monkeypatch):
    """Between two rows an interpolated path would have less of it, and fit better."""
    rows, costs = circling(1.2, 0.8, 0.0178), []
    noise = np.random.default_rng(0).standard_normal((2, *rows["pos"].shape))
    monkeypatch.setattr(path, "GOOD", np.inf)
    monkeypatch.setattr(path, "best_delay", lambda _, cost: costs.append(cost.sum(axis=0)))
    path.delay_of_path(rows["time"], axes_of(rows["time"], rows["quat"]), *(10.0 * noise))
    assert costs[0].max() < 1.2 * costs[0].min()


def test_without_acceleration_the_delay_is_not_identifiable(log):
    still = replace(
        log,
        pos_w=np.zeros_like(log.pos_w) + [0.0, 0.0, 1.0],
        vel_w=np.zeros_like(log.vel_w),
        quat_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (len(log.time_s), 1)),
    )
    assert all(f.status == "not identifiable" for f in findings(still)[1])


@pytest.mark.parametrize("turn_deg", [-8.0, 45.0])
def test_another_heading_of_the_path_is_the_only_finding(log, turn_deg):
    turn = Rotation.from_euler("z", turn_deg, degrees=True)
    turned = replace(log, pos_w=turn.apply(log.pos_w), vel_w=turn.apply(log.vel_w))
    (found,), _ = findings(turned)
    assert found.fault == "heading" and found.size == pytest.approx(turn_deg, abs=2.0)
    assert f"turned by {found.size:+.0f} deg" in found.evidence


@pytest.mark.parametrize("seed", [0, more(3)])
def test_a_heading_near_a_quarter_turn_is_swapped_axes_and_another_one_is_not(log, seed):
    log = fly(PLAIN, seed, duration_s=8.0) if seed else log
    for turn_deg, faults in ((60.0, {"heading"}), (90.0, {"position_axes", "velocity_frame"})):
        turn = Rotation.from_euler("z", turn_deg, degrees=True)
        opened, _ = findings(replace(log, pos_w=turn.apply(log.pos_w), vel_w=turn.apply(log.vel_w)))
        assert {finding.fault for finding in opened} == faults


def test_a_body_that_is_turned_by_45_deg_does_not_make_rates_those_of_world_axes(log):
    body = Rotation.from_quat(log.quat_wxyz, scalar_first=True)
    turned = body * Rotation.from_euler("z", 45.0, degrees=True)
    opened, _ = findings(replace(log, quat_wxyz=turned.as_quat(scalar_first=True)))
    assert {finding.fault for finding in opened} == {"body_frame"}


def test_an_accelerometer_with_gravity_twice_does_not_invert_the_position(log):
    down_b = Rotation.from_quat(log.quat_wxyz, scalar_first=True).apply([0.0, 0.0, 9.81], True)
    acc_w = np.gradient(log.vel_w, log.time_s, axis=0)
    inverse = Rotation.from_quat(log.quat_wxyz, scalar_first=True).inv()
    wrong = replace(log, acc_b=inverse.apply(acc_w) - down_b)
    assert {finding.signal for finding in findings(wrong)[0]} == {"accelerometer"}


def test_a_small_heading_and_a_calm_flight_are_no_finding(log):
    turn = Rotation.from_euler("z", 3.0, degrees=True)
    found, _ = check_log(replace(log, pos_w=turn.apply(log.pos_w), vel_w=turn.apply(log.vel_w)))
    assert [f.status for f in found if f.signal == "heading"] == ["ok"]
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(log.time_s), 1))
    (unseen,) = check_heading({"time": log.time_s, "pos": 0.0 * log.pos_w, "quat": level})
    assert unseen.status == "not identifiable"

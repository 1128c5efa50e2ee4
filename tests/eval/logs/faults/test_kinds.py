"""Every kind of fault is named, its fix restores the flight, and good flights stay as they are."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from eval.importers.cleaning import check_delay
from eval.importers.signals import Recording, Signal
from eval.logs.faults.catalogue import FAULTS
from eval.logs.faults.check import (
    CLOCK,
    DRIVE,
    POSE,
    CheckContext,
    check_files,
    check_log,
    run_checks,
    with_fixes,
)
from eval.logs.faults.clocks.delay import OF_POSE, check_clock, delay_of
from eval.logs.faults.drive import commands
from eval.logs.faults.drive.commands import check_controller_rate
from eval.logs.faults.drive.rate_following import delayed
from eval.logs.faults.pose import check_pose
from eval.logs.faults.position import check_height
from eval.logs.faults.reading import parse_readings, read_rows
from eval.logs.flight_log import read_flight
from suite.diagnose.example.flights import FOLDER
from suite.experiments.injected.flights import with_linear_motors
from suite.experiments.injected.kinds import KINDS, inject
from tests.support import known_flight
from tests.support.marks import more
from tests.support.vehicles import PLAIN

VEHICLE = with_linear_motors(PLAIN)
HZ, POLICY_HZ = 100.0, 30.0
NOISE = {"pos": 0.002, "vel": 0.02, "rate": 0.03, "quat": 0.001, "acc": 0.3, "motor": 3.0}

OPEN = {
    "gyro 20 % too large", "accelerometer's sign", "accelerometer forward-right-down",
    "accelerometer's bias with throttle", "pose late by 60 ms", "pose's clock off by 0.5 %",
    "12 poles declared of 14", "motor 3 never turns", "spin of all motors",
    "thrust command in newtons", "linear stick map against a rates curve",
    "commands act 150 ms later", "loop at two thirds of its rate (20 of 30 Hz)",
    "throttle is a share of the motors' speed", "motor map of another curve",
    "motor map of twice the thrust", "battery compensated twice", "mass on five links",
    "arms in mm", "speed_max in rpm", "inertia x 1000", "barometer falls on spin-up",
    "field of view", "thrust -10 %", "stamps of arrival, up to 80 % of a row late",
    "position late by 150 ms", "set point 150 ms ahead as position", "compass off by 15 deg",
    "rotor speeds held for 0.1 s", "rotor speeds that drop out", "motor 4 is a copy of motor 3",
    "velocity through the air", "rotor speeds late by 60 ms", "pose's clock set by 60 ms in flight",
    "clock 6 % too slow",
}  # fmt: skip
"""Kinds that are reported and left to the reader; all others are corrected."""


def good(seed=0, end=16.0):
    """A flight as a logger has it: noise, commands that hold, and a body that follows in 50 ms."""
    return {name: part.copy() for name, part in logged(seed, end).items()}


@cache
def logged(seed, end):
    truth = known_flight.fly(np.arange(0.0, end, 1.0 / HZ))
    held = (np.floor(truth.time * POLICY_HZ) / POLICY_HZ * HZ).astype(int)
    wanted = known_flight.fly(truth.time + 0.05).cmd_rate[held]
    thrust = truth.thrust[held][:, None]
    parts = {
        "time": truth.time, "pos": truth.pos, "quat": truth.quat, "vel": truth.vel,
        "rate": truth.rate, "acc": truth.acc, "motor": truth.motor, "cmd_thrust": thrust,
        "cmd_rate": wanted, "throttle": thrust / PLAIN.full_thrust,
        "pwm": (truth.motor / PLAIN.rotors.speed_max) ** 2,
        "voltage": truth.voltage[:, None], "baro": truth.pos[:, 2:].copy(),
    }  # fmt: skip
    rng = np.random.default_rng(seed)
    for name, size in NOISE.items():
        parts[name] = parts[name] + size * rng.normal(size=parts[name].shape)
    parts["quat"] /= np.linalg.norm(parts["quat"], axis=1, keepdims=True)
    return parts


def checked(parts, vehicle=VEHICLE, fov=1.0):
    wide, high = vehicle.camera.fov_deg
    camera = replace(vehicle.camera, fov_deg=(fov * wide, fov * high))
    against = CheckContext(vehicle, POLICY_HZ, camera)
    checks = (*CLOCK, *POSE, lambda rows, _: check_clock(rows), *DRIVE)
    findings, readings, _ = run_checks(parts, checks, against, fix=True)
    commands = {name: value for name, value in parts.items() if name != "throttle"}
    findings += check_controller_rate(commands, POLICY_HZ)
    return findings + check_files(against), readings


def named(findings):
    return {f.fault for f in findings if f.fault and f.status in ("corrected", "doubt", "note")}


ELSEWHERE = ("clock_offset", "heading", "motor_telemetry", "position_delay", "velocity_mean")
"""Faults that `test_path` and `test_telemetry` have in other flights."""
FIRST = {k.names[0]: n for n, k in reversed(KINDS.items()) if k.names[0] not in ELSEWHERE}.values()
"""The first kind of each other fault."""


@pytest.mark.parametrize("name", [name if name in FIRST else more(name) for name in KINDS])
def test_a_fault_is_named_and_its_fix_restores_the_flight(name):
    kind, right = KINDS[name], good(end=10.0)
    wrong = inject(kind, right, VEHICLE)
    vehicle = VEHICLE if kind.vehicle is None else kind.vehicle(VEHICLE)
    findings, readings = checked(wrong, vehicle, kind.fov)
    assert named(findings) & set(kind.names)
    corrected = [f for f in findings if f.fault in kind.names and f.status == "corrected"]
    assert bool(corrected) == (name not in OPEN) and OPEN <= KINDS.keys()
    if corrected:
        fixed = read_rows(wrong, readings)
        fixed["quat"] *= np.sign(np.sum(fixed["quat"] * right["quat"], axis=1, keepdims=True))
        assert right.keys() - fixed.keys() == ({"voltage"} if name == "battery of 0.1 V" else set())
        for signal in fixed:
            np.testing.assert_allclose(fixed[signal], right[signal], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("wrong", "signal", "fix"),
    [
        ("cmd_rate=0.01745329252", "rate command", "cmd_rate=57.29577951"),
        more("cmd_rate=y,x,z", "rate command", "cmd_rate=y,x,z"),
        ("motor=0.10471975512", "rotor speeds", "motor=9.549296586"),
        more("pos=0.001", "position", "pos=1000"),
        ("pos=y,x,z", "position", "pos=y,x,z"),
    ],
)
def test_the_fix_names_the_signal_whose_unit_or_order_is_wrong(wrong, signal, fix):
    findings, _ = checked(read_rows(good(end=10.0), parse_readings([wrong])))
    (found,) = (f for f in findings if f.status in ("corrected", "doubt"))
    assert (found.signal, found.fix) == (signal, f"--read {fix}")


def test_stick_pulses_are_no_degrees_per_second():
    parts = good(end=8.0)
    parts["cmd_rate"] = 1500.0 + 50.0 * parts["cmd_rate"]
    (found,) = [f for f in checked(parts)[0] if f.signal == "rate command"]
    assert (found.fault, found.is_open) == ("rate_command_unit", True)
    assert "stick pulses" in found.evidence and "--read" not in found.fix


@pytest.mark.parametrize(("late_s", "ahead_s"), [(0.05, 0.0), (0.15, 0.1), more(0.3, 0.25)])
def test_commands_that_follow_the_gyro_are_logged_too_late(late_s, ahead_s):
    parts = good(end=10.0)
    parts["cmd_rate"] = np.roll(parts["cmd_rate"], round(late_s * HZ), axis=0)
    found = [f for f in checked(parts)[0] if f.signal == "rate command" and f.is_open]
    assert [f.fault for f in found] == ["command_delay"] * bool(ahead_s)
    assert not found or found[0].size == pytest.approx(-ahead_s, abs=0.04)


def test_commands_of_swapped_axes_are_not_late():
    """By its own axis the command may fit best after another time."""
    time_s = good(end=10.0)["time"]
    wave = np.column_stack([np.sin(3.0 * time_s), np.cos(3.0 * time_s), np.sin(5.0 * time_s)])
    late, _ = delayed(time_s, wave[:, [1, 0, 2]], np.roll(wave, 5, axis=0))
    assert late == pytest.approx(0.05, abs=0.011)


@pytest.mark.parametrize("name", ["motors 3 and 4 swapped", "accelerometer's bias with throttle"])
def test_a_gap_of_a_signal_leaves_its_check(name):
    wrong = inject(KINDS[name], good(end=10.0), VEHICLE)
    for signal in ("motor", "pwm", "throttle", "acc"):
        wrong[signal][100:120] = np.nan
    assert named(checked(wrong)[0]) & set(KINDS[name].names)


@pytest.mark.parametrize("name", ["throttle", "pwm"])
def test_an_outlier_is_no_other_range(name):
    parts = good(end=10.0)
    parts[name][300] = 3.0
    findings, readings = checked(parts)
    (found,) = (f for f in findings if f.fault == "throttle_range")
    assert "1 rows of outliers" in found.evidence and not found.is_open and not readings


@pytest.mark.parametrize("name", ["throttle", "pwm"])
def test_commands_that_were_divided_by_too_large_a_range_are_doubted(name):
    parts = good(end=10.0)
    parts[name] = parts[name] / 65535.0
    (found,) = (f for f in checked(parts)[0] if f.fault == "throttle_range")
    assert "lifts no vehicle" in found.evidence and found.is_open


@pytest.mark.parametrize("wrong", ["acc=-x,-y,-z", more("acc=x,-y,-z")])
def test_an_axis_without_force_does_not_show_its_sign(wrong):
    right = good(end=8.0)
    findings, readings = checked(read_rows(right, parse_readings((wrong,))))
    assert named(findings) == {"accelerometer_axes"} and not readings
    (finding,) = (f for f in findings if f.is_open)
    assert {"-x,-y,-z", "x,-y,-z"} <= set(re.split("[ =]", finding.fix))
    # In g as well: each of the readings converts the unit.
    findings, _ = checked(read_rows(right, parse_readings((f"{wrong}+0.1019367992",))))
    (finding,) = (f for f in findings if f.is_open)
    assert finding.fault == "accelerometer_unit"
    assert {"9.81+-x,-y,-z", "9.81+x,-y,-z"} <= set(re.split("[ =]", finding.fix))
    # In a body that is pitched by 10 degrees, thrust has a part along x, which shows its sign.
    pitch = Rotation.from_euler("y", 10.0, degrees=True)
    flown = Rotation.from_quat(right["quat"], scalar_first=True)
    right["quat"] = (flown * pitch).as_quat(scalar_first=True)
    right |= {name: pitch.inv().apply(right[name]) for name in ("acc", "rate", "cmd_rate")}
    wrong_rows = read_rows(right, parse_readings((wrong,)))
    _, readings = checked(wrong_rows)
    np.testing.assert_allclose(read_rows(wrong_rows, readings)["acc"], right["acc"])


@pytest.mark.parametrize("seed", [0, more(1)])
def test_a_good_flight_has_no_fault(seed):
    findings, readings = checked(good(seed))
    assert not named(findings) and not readings


@pytest.mark.parametrize(
    ("wrong", "names"),
    [
        ((), set()),
        more(("rate=x,-y,z",), {"gyro_axes"}),
        (("rate=x,-y,-z",), {"body_frame"}),
        (("rate=x,-y,-z", "acc=x,-y,-z", "cmd_rate=x,-y,-z"), {"body_frame", "accelerometer_axes"}),
        more(("acc=-x,-y,-z",), {"accelerometer_axes"}),
        (("acc=z,y,-x",), {"accelerometer_axes"}),
        more(("rate=57.3",), {"gyro_scale"}),
        (("rate=0.01745329252",), {"gyro_scale"}),
        more(("motor=1,2,4,3",), {"motor_order"}),
        more(("cmd_rate=x,-y,z",), {"rate_command_sign"}),
    ],
)
def test_without_a_pose_a_second_witness_decides_which_signal_is_wrong(wrong, names):
    right = {name: part for name, part in good().items() if name not in ("pos", "quat", "vel")}
    findings, readings = checked(read_rows(right, parse_readings(wrong)))
    assert named(findings) == names
    if any(text.startswith("rate=") for text in wrong):
        fixed = read_rows(read_rows(right, parse_readings(wrong)), readings)["rate"]
        np.testing.assert_allclose(fixed, right["rate"], rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize(
    ("wrong", "lost", "name", "fix"),
    [
        ("rate=1.2", (), "gyro_scale", 1.0 / 1.2),
        more("rate=0.8", (), "gyro_scale", 1.25),
        ("rate=1.2", ("motor", "pwm"), "rate_curve", 1.2),
        more("cmd_rate=0.8", (), "rate_curve", 1.25),
    ],
)
def test_without_a_pose_a_rate_loops_gain_shows_a_wrong_scale(wrong, lost, name, fix):
    """No other fault is named after it, and the motors' torques tell a gyro from a stick map."""
    right = {n: v for n, v in good().items() if n not in ("pos", "quat", "vel", *lost)}
    findings, _ = checked(read_rows(right, parse_readings((wrong,))))
    assert named(findings) == {name}
    (finding,) = (f for f in findings if f.fault == name and f.status == "doubt")
    assert finding.is_open
    assert float(finding.fix.split("=")[-1]) == pytest.approx(fix, rel=0.03)


@pytest.mark.parametrize(
    ("source", "late_s"),
    [("acc", -0.15), more("acc", 0.06), ("cmd_thrust", -0.15), more("motor", 0), ("motor", 0.06)],
)
def test_each_measure_of_the_force_shows_that_z_of_the_position_is_inverted(source, late_s):
    right = {name: good(end=10.0)[name] for name in ("time", "pos", "quat", "rate", source)}
    right[source] = np.roll(right[source], round(HZ * late_s), axis=0)
    inverted = read_rows(right, parse_readings(("pos=x,y,-z",)))
    findings, readings = checked(inverted)
    assert "position_axes" in named(findings) and ("pos", "x,y,-z") in readings
    np.testing.assert_array_equal(read_rows(inverted, readings)["pos"], right["pos"])
    findings, _ = checked(right)
    assert "position_axes" not in {f.fault for f in findings}


def test_the_examples_flights_show_that_z_of_the_position_is_inverted():
    log = read_flight(FOLDER / "flight_1.parquet")
    assert "position_axes" not in {f.fault for f in check_log(log)[0]}
    findings, readings = check_log(with_fixes(log, (("pos", "x,y,-z"),)), fix=True)
    assert named(findings) == {"position_axes"} and readings == (("pos", "x,y,-z"),)


def test_a_force_that_is_unrelated_to_the_path_does_not_show_the_sign_of_z():
    rng, count = np.random.default_rng(2), 0
    time_s = np.arange(0.0, 8.0, 0.02)
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(time_s), 1))
    for _ in range(200):  # both change within half a second
        pos, force = gaussian_filter1d(rng.normal(size=(2, len(time_s), 3)), 12.0, axis=1)
        rows = {"time": time_s, "pos": pos, "quat": quat, "acc": force + [0.0, 0.0, 9.81]}
        (finding,) = check_height(rows)
        count += finding.status != "not identifiable"
    assert count <= 1


def test_a_position_in_few_rows_does_not_confirm_a_wrong_attitude():
    rows = good(end=60.0)
    rows["quat"], rows["pos"][120:] = np.roll(rows["quat"], 700, axis=0), np.nan
    alone = {name: value for name, value in rows.items() if name != "pos"}
    for (found,) in map(check_pose, (rows, alone)):
        assert found.status == "doubt" and found.evidence.startswith("its turns are off")


def test_a_calm_flight_says_what_it_does_not_show():
    still = good(end=4.0)
    hover = {"quat": [1.0, 0.0, 0.0, 0.0], "rate": [0.0, 0.0, 0.0], "acc": [0.0, 0.0, 9.81]}
    hover["vel"] = [0.0, 0.0, 0.0]
    for name in ("pos", "quat", "vel", "rate", "acc", "cmd_rate"):
        still[name][:] = hover.get(name, still[name][0])
    findings, _ = checked(still)
    unseen = {f.fault for f in findings if f.status == "not identifiable"}
    assert unseen >= {"attitude", "gyro_scale", "velocity_frame", "motor_order"}
    assert unseen <= FAULTS.keys()
    assert not {f.fault for f in findings if f.is_open}


@pytest.mark.parametrize("since_s", [more(0.0), 3.0])
@pytest.mark.parametrize(("name", "signal"), [("quat", "attitude"), ("pos", "position")])
def test_a_pose_that_stands_still_while_the_gyro_turns_is_no_other_unit(name, signal, since_s):
    parts = good(end=8.0)
    first = int(since_s * HZ)
    parts[name][first:] = parts[name][first]
    doubts = [f for f in checked(parts)[0] if f.status in ("corrected", "doubt")]
    assert [(f.signal, f.is_open) for f in doubts] == [(signal, True)]
    assert "stands still while the gyro turns" in doubts[0].evidence


@pytest.mark.parametrize("late_s", [0.0, 0.06])
@pytest.mark.parametrize(("angle", "status"), [(3.0, ""), (10.0, "note"), (30.0, "doubt")])
def test_a_body_that_is_defined_askew_is_no_delay(angle, status, late_s):
    parts = good()
    parts["quat"] = known_flight.fly(parts["time"] - late_s).quat
    turn = Rotation.from_euler("z", angle, degrees=True)
    turned = Rotation.from_quat(parts["quat"], scalar_first=True) * turn
    parts["quat"] = turned.as_quat(scalar_first=True)
    found = check_clock(parts)
    axes = [f for f in found if f.signal == "pose axes"]
    assert [(f.status, f.is_open) for f in axes] == [(status, status == "doubt")] * bool(status)
    (delay,) = [f for f in found if f.signal == "pose delay"]
    ms = float(delay.evidence.split("it is ")[1].split(" ms")[0])
    assert ms == pytest.approx(1e3 * late_s, abs=6.0)


def test_a_clock_that_is_set_in_flight_is_neither_a_drift_nor_a_delay():
    parts = good()
    set_s = np.where(parts["time"] > parts["time"].mean(), -0.05, 0.0)
    parts["quat"] = known_flight.fly(parts["time"] - set_s).quat
    (jump,) = [f for f in check_clock(parts) if f.status != "ok"]
    assert (jump.fault, jump.size) == ("clock_drift", pytest.approx(-0.05, abs=0.005))
    streams = {name: Signal(parts["time"], parts[name]) for name in ("pos", "vel", "quat", "rate")}
    shifted = check_delay(Recording("a log", streams), fix=True)
    assert np.array_equal(shifted.signals["quat"].time_s, parts["time"])
    assert [f.status for f in shifted.findings] == ["doubt"]


@pytest.mark.parametrize("axes", [[0], more([2]), [0, 1, 2]])
def test_an_axis_of_the_gyro_that_is_dead_is_no_order_of_the_motors(axes):
    parts = good(end=8.0)
    parts["rate"][:, axes] = 0.0
    doubts = [f for f in checked(parts)[0] if f.status in ("corrected", "doubt")]
    assert [(f.fault, f.is_open) for f in doubts] == [("gyro_axes", True)]


def test_every_name_is_in_the_catalogue():
    assert {name for kind in KINDS.values() for name in kind.names} <= FAULTS.keys()
    assert sum(kind.race for kind in KINDS.values()) == 10


def test_a_rates_curve_gives_more_of_large_commands_and_motors_limits_give_less():
    rng = np.random.default_rng(3)
    time_s = np.arange(0.0, 40.0, 0.01)
    command = np.repeat(rng.normal(0.0, 1.0, (80, 3)), 50, axis=0)
    curved = command * (0.5 + np.abs(command))
    assert commands.bend(time_s, command, curved) > commands.BENT
    assert commands.bend(time_s, command, np.clip(command, -0.8, 0.8)) == 0.0
    assert abs(commands.bend(time_s, command, 0.9 * command)) < 1e-6


@pytest.mark.parametrize(
    ("late", "moved"),
    [
        (("rate",), ("rate",)),
        (("rate", "acc"), ("rate", "acc")),
        (("acc", "cmd_rate", "motor", "rate"), OF_POSE),
    ],
)
def test_a_late_gyro_shifts_no_pose_and_the_motors_show_a_pose_that_is_early(late, moved):
    right = good(end=10.0)
    rows = right | {name: np.roll(right[name], 4, axis=0) for name in late}
    signals = {name: Signal(rows["time"], rows[name]) for name in rows if name != "time"}
    fixed = check_delay(Recording("test", signals), fix=True)
    (finding,) = fixed.findings
    shifted = {name for name in signals if fixed.signals[name].time_s[0] != rows["time"][0]}
    assert shifted == set(moved) and finding.size == pytest.approx(-0.04, abs=0.006)
    after = delay_of(*fixed.signals["quat"], *fixed.signals["rate"])
    assert abs(after.delay_s) < 0.002
    assert ("gyro delay" == finding.signal) == ("rate" in moved)
    (delay,) = (f for f in check_clock(rows) if f.fault == "clock_offset")
    assert (delay.signal, delay.is_open) == (finding.signal, True)

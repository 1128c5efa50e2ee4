"""The map from motor commands or a throttle to thrust: its size, its curve, the battery."""

import re
from dataclasses import replace

import numpy as np
import pytest

from eval.logs.faults.drive.motor_map import check_motor_map
from eval.logs.faults.sensors import check_voltage
from eval.quadrotor.loops import KINDS
from eval.vehicles.vehicle import MotorMap, command_of_thrust
from tests.support.vehicles import PLAIN

TRUE = MotorMap((1.5, 4.0), 15.0, 1.0)


def flown(depth=0.4, drained=True, seed=0, seconds=40.0):
    """Rows of a vehicle whose motors are `TRUE`: rotors 30 ms behind their commands."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(0.0, seconds, 0.01)
    waves = np.array([[0.9, 0.0], [1.7, 1.0], [2.9, 2.0], [0.35, 3.0]])
    each = [np.sin(w * time_s + p + k) for k in range(4) for w, p in waves]
    swing = np.reshape(each, (4, 4, -1)).mean(axis=1).T
    thrust = 9.81 * PLAIN.mass / 4.0 * (1.0 + depth * swing)
    volts = np.interp(time_s, (0.0, seconds), (16.5, 13.5)) if drained else 15.0 + 0.0 * time_s
    pwm = command_of_thrust(TRUE.thrust, thrust) * (TRUE.voltage / volts)[:, None]
    late = np.concatenate([np.repeat(thrust[:1], 3, axis=0), thrust])[: len(time_s)]
    force = late.sum(axis=1) / PLAIN.mass + 0.3 * rng.normal(size=len(time_s))
    acc = np.column_stack([0.0 * force, 0.0 * force, force])
    return {"time": time_s, "acc": acc, "pwm": pwm, "voltage": volts[:, None],
            "motor": np.sqrt(late / PLAIN.rotors.thrust_coefficient)}  # fmt: skip


def with_motors(**changes):
    return replace(PLAIN, motors=replace(TRUE, **changes))


def found(rows, vehicle):
    return [f for f in check_motor_map(rows, vehicle) if f.status == "doubt"]


@pytest.mark.parametrize("by", ["motor", "acc"])
@pytest.mark.parametrize(
    ("changes", "faults"),
    [
        ({}, []),
        ({"thrust": (0.0, 9.5)}, ["motor_map"]),
        ({"thrust": (6.0, 0.0)}, ["motor_map"]),
        ({"thrust": (3.0, 8.0)}, ["motor_map"]),
        ({"thrust": (0.6, 1.6)}, ["motor_map"]),
        ({"voltage_exponent": 0.0}, ["battery_scaling"]),
        ({"voltage_exponent": 2.5}, ["battery_scaling"]),
    ],
)
def test_the_fault_is_named_and_the_fix_is_the_map_that_was_flown(by, changes, faults):
    rows = flown()
    del rows["acc" if by == "motor" else "motor"]
    findings = found(rows, with_motors(**changes))
    assert [f.fault for f in findings] == faults
    for finding in findings:
        first, second, voltage, exponent = map(float, re.findall(r"\d[\d.e-]*", finding.fix))
        fixed = MotorMap((first, second), voltage, exponent)
        assert exponent == pytest.approx(1.0, abs=0.1)
        assert not found(rows, replace(PLAIN, motors=fixed)), "the fix is right"
        gives = [first * u + second * u**2 for u in (u0 * 15.0 / voltage for u0 in (0.4, 0.55))]
        assert gives == pytest.approx([1.5 * u + 4.0 * u**2 for u in (0.4, 0.55)], rel=0.06)


def test_a_long_time_on_the_ground_does_not_hide_a_wrong_map():
    rows, vehicle = flown(), with_motors(thrust=(6.0, 0.0))
    rows |= {name: rows[name] * (rows["time"] > 22.0)[:, None] for name in ("pwm", "motor")}
    assert [finding.fault for finding in found(rows, vehicle)] == ["motor_map"]


@pytest.mark.parametrize("factor", [0.25, 0.5, 2.0, 4.0])
def test_a_voltage_far_from_the_nominal_one_of_the_motors_is_in_doubt(factor):
    rows, vehicle = flown(), with_motors()
    for scale, where, status in (
        (1.0, vehicle, "ok"),
        (factor, vehicle, "doubt"),
        (factor, PLAIN, "ok"),
        (factor, with_motors(voltage_exponent=0.0), "ok"),
    ):
        (finding,) = check_voltage({"voltage": scale * rows["voltage"]}, where)
        assert finding.status == status


def test_what_a_flight_does_not_show_is_reported_as_not_identifiable():
    def unseen(rows, vehicle):
        findings = check_motor_map(rows, vehicle)
        assert not [f for f in findings if f.status == "doubt"]
        return {f.fault for f in findings if f.status == "not identifiable"}

    hover = flown(depth=0.02, drained=False)
    assert unseen(hover, with_motors(thrust=(0.0, 6.9))) == {"motor_map", "battery_scaling"}
    rows = flown()
    del rows["acc"], rows["motor"]
    assert unseen(rows, with_motors()) == {"motor_map", "battery_scaling"}
    assert unseen(flown(drained=False), with_motors(voltage_exponent=0.0)) == {"battery_scaling"}


@pytest.mark.parametrize(
    ("power", "factor", "vehicle", "faults"),
    [
        (1.0, 1.0, PLAIN, []),
        (1.0, 1.0, None, []),
        (0.5, 1.0, PLAIN, ["throttle_curve"]),
        (0.5, 1.0, None, ["throttle_curve"]),
        (1.0, 2.0, PLAIN, ["throttle_curve"]),
        (1.0, 2.0, None, []),  # no file says what full throttle gives
    ],
)
def test_a_throttle_that_is_not_linear_or_of_another_full_thrust_is_named(
    power, factor, vehicle, faults
):
    rows = flown(depth=1.0)
    total = rows["motor"] ** 2 @ np.full(4, PLAIN.rotors.thrust_coefficient)
    share = total / (PLAIN.full_thrust * PLAIN.mass)
    rows = {"time": rows["time"], "acc": rows["acc"], "throttle": factor * share[:, None] ** power}
    assert [f.fault for f in found(rows, vehicle)] == faults


@pytest.mark.parametrize(("depth", "faults"), [(0.5, []), (1.0, ["throttle_curve"])])
def test_a_drag_along_z_is_no_other_curve_where_the_thrust_hardly_changes(depth, faults):
    rows = flown(depth=depth, drained=False)
    command = rows["motor"] ** 2 @ np.full((4, 1), PLAIN.rotors.thrust_coefficient / PLAIN.mass)
    slowed = 9.81 + 0.65 * (rows["acc"] - 9.81)  # the climb that more thrust causes opposes it
    findings = check_motor_map({"time": rows["time"], "acc": slowed, "cmd_thrust": command}, PLAIN)
    assert [f.fault for f in findings if f.status == "doubt"] == faults
    assert any("to the power 0.6" in str(finding) for finding in findings)


@pytest.mark.parametrize(
    ("kind", "settings", "throttle_of"),
    [
        ("betaflight", {"dshot_idle_value": 2000.0}, lambda u: (u - 0.2) / 0.8),
        ("px4", {"THR_MDL_FAC": 0.8}, lambda u: 0.8 * u**2 + 0.2 * u),
    ],
)
def test_the_throttle_of_a_firmware_is_no_other_curve_than_that_of_its_motors(
    kind, settings, throttle_of
):
    rows = flown(depth=1.0, drained=False)
    total = rows["motor"] ** 2 @ np.full(4, PLAIN.rotors.thrust_coefficient)
    command = command_of_thrust(TRUE.thrust, total[:, None] / 4.0)
    rows = {"time": rows["time"], "acc": rows["acc"], "throttle": throttle_of(command)}
    controller = replace(PLAIN.controller, kind=kind, settings=KINDS[kind].Settings(**settings))
    assert not found(rows, replace(with_motors(), controller=controller))
    assert [f.fault for f in found(rows, with_motors())] == ["throttle_curve"]


@pytest.mark.parametrize(("late", "expected"), [(12, ["throttle_curve"]), (30, [])])
def test_a_curve_needs_a_delay_that_is_known(late, expected):
    """A throttle with a wrong curve, so late that no tried delay fits, shows nothing."""
    rows = flown(depth=1.0)
    total = rows["motor"] ** 2 @ np.full(4, PLAIN.rotors.thrust_coefficient)
    throttle = np.roll(total / (PLAIN.full_thrust * PLAIN.mass), -late) ** 0.5
    rows = {"time": rows["time"], "acc": rows["acc"], "throttle": throttle[:, None]}
    assert [f.fault for f in found(rows, PLAIN)] == expected

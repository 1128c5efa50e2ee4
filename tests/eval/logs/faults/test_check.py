"""Readings of a log, and findings that an import stored in it."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from eval.importers.frames import rotate
from eval.logs.faults.catalogue import FAULTS
from eval.logs.faults.check import (
    DRIVE,
    POSE,
    CheckContext,
    check_log,
    rows_of,
    run_checks,
    with_fixes,
)
from eval.logs.faults.checked import check_flights, lines_of
from eval.logs.faults.finding import Finding
from eval.logs.faults.position import check_jumps
from eval.logs.faults.reading import parse_readings, read_rows
from eval.logs.faults.sensors import check_barometer
from eval.logs.flight_log import FlightLog, columns_from_log, log_from_columns, write_flight
from suite.commands.check import Config, run
from suite.common.console import Console
from tests.support.diagnosis_flights import part_of, without_fault
from tests.support.imported import flight
from tests.support.marks import more
from tests.support.vehicles import PLAIN

ROOT = Path(__file__).resolve().parents[4]


@cache
def flown(duration_s=3.0, begin_s=0.0):
    """Part of a flight without a fault; no test writes into its arrays."""
    log = part_of(without_fault(), begin_s, begin_s + duration_s)
    return replace(log, rotor_speed=None)


def flight_at_rest(time_s):
    still = np.zeros((len(time_s), 3))
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(time_s), 1))
    return FlightLog("log", time_s, still, level, still, still, np.full(len(time_s), 9.81), still)


def faults(parts):
    """The doubts and corrections of these rows."""
    findings, _, _ = run_checks(parts, (*POSE, *DRIVE), CheckContext(), True)
    return [f for f in findings if f.status in ("doubt", "corrected")]


def test_commands_that_few_rows_have_are_held_as_those_that_every_row_has():
    time_s, command = np.arange(0.0, 20.0, 0.01), np.zeros((2000, 3))
    command[:] = np.repeat(np.random.default_rng(0).uniform(-2.0, 2.0, (100, 3)), 20, axis=0)
    rate = np.zeros((2000, 3))
    for k in range(1999):
        rate[k + 1] = rate[k] + 0.15 * (command[k] - rate[k])
    log = replace(
        flight_at_rest(time_s), rate_b=rate, rate_cmd_b=command, about={"partial": ["quat", "pos"]}
    )
    is_new = np.arange(2000)[:, None] % 20 == 0
    sparse = replace(log, rate_cmd_b=np.where(is_new, command, np.nan))
    np.testing.assert_array_equal(rows_of(sparse)["cmd_rate"], command)
    found, same = (
        [f for f in check_log(one)[0] if f.signal == "rate command"] for one in (sparse, log)
    )
    assert [f.status for f in found] == ["ok"] and found == same


@pytest.mark.parametrize("text", ["time=0", "time=-1", "time=nan", "rate=ms", "time=drop"])
def test_a_time_takes_a_unit_or_a_positive_factor(text):
    with pytest.raises(ValueError, match="is no step of"):
        parse_readings([text])
    np.testing.assert_allclose(
        read_rows({"time": np.arange(3.0)}, parse_readings(["time=0.8"]))["time"], [0.0, 0.8, 1.6]
    )


@pytest.mark.extended
@pytest.mark.parametrize("factor", [more(0.95), 1.08])
def test_a_small_error_of_a_clocks_rate_needs_gyro_and_velocity(factor):
    log = flown(8.0)
    scaled = {
        "clock": {"time_s": factor * log.time_s},
        "gyro": {"rate_b": factor * log.rate_b},
        "velocity": {"vel_w": factor * log.vel_w},
        "position": {"pos_w": factor**2 * log.pos_w, "vel_w": factor**2 * log.vel_w},
    }
    for name, change in scaled.items():
        found, _ = check_log(replace(log, **change), CheckContext(PLAIN))
        sizes = [f.size for f in found if f.is_open]
        assert sizes == ([pytest.approx(factor, rel=0.01)] if name == "clock" else []), name
        noted = {f.signal for f in found if f.status == "note" and "a clock" in f.evidence}
        assert noted <= {name} and (noted or name in ("clock", "position"))


@pytest.mark.parametrize("factor", [more(0.5), 1.25])
def test_a_clock_of_another_rate_is_one_fault(factor):
    parts = flight(100.0, 10.0, 0.3)
    parts["time"] = factor * parts["time"]
    (doubt,) = faults(parts)
    assert doubt.fault == "time_unit" and doubt.is_open
    assert float(doubt.fix.split("time=")[1]) == pytest.approx(1.0 / factor, rel=0.02)
    parts["time"] = parts["time"] / factor
    parts["rate"] = factor * parts["rate"]
    assert "time_unit" not in {f.fault for f in faults(parts)}


def test_feet_are_named_and_the_fix_restores_metres():
    parts = flight(100.0, 10.0, 1.0)
    parts["pos"] = parts["pos"] / 0.3048
    (found,) = faults(parts)
    assert found.fault == "position_unit" and found.fix == "--read pos=0.3048"


@pytest.mark.parametrize("text", ["time=ms+us", "rate=drop+2", "quat=drop+xyzw"])
def test_a_unit_of_time_and_a_drop_stand_alone(text):
    with pytest.raises(ValueError, match="'ms' stands alone|'drop' stands alone"):
        parse_readings([text])


def test_the_exponent_of_a_factor_may_have_a_plus():
    readings = parse_readings(["rate=1e+3+x,-y,z"])
    rows = read_rows({"rate": np.ones((1, 3))}, readings)
    np.testing.assert_array_equal(rows["rate"], [[1e3, -1e3, 1e3]])


def test_a_stored_finding_on_another_vehicle_file_is_not_repeated_and_one_on_the_log_is():
    stored = [
        Finding("doubt", "motor map", "the file gives twice the thrust", "motor_map", fix="t1"),
        Finding("doubt", "voltage", "0 V", "voltage"),
    ]
    log = replace(flown(), about={"findings": [one._asdict() for one in stored]})

    def faults(context):
        return [one.fault for one in check_log(log, context)[0] if one.status == "doubt"]

    assert faults(CheckContext()) == ["motor_map", "voltage"]
    assert faults(CheckContext(PLAIN)) == ["voltage"]


@pytest.mark.parametrize("lost", ["baro", "pos"])
def test_a_barometer_without_samples_around_the_start_is_not_checked(lost):
    time_s = np.arange(0.0, 5.0, 0.01)
    rows = {
        "time": time_s, "throttle": np.where(time_s > 2.0, 0.5, 0.0)[:, None],
        "baro": np.zeros((500, 1)), "pos": np.zeros((500, 3)),
    }  # fmt: skip
    assert [finding.status for finding in check_barometer(rows)] == ["ok"]
    rows[lost][190:320] = np.nan
    assert not check_barometer(rows)


def test_a_throttle_that_begins_late_does_not_start_the_motors():
    log, rng = flown(), np.random.default_rng(0)
    throttle = np.where(np.arange(301) % 3 == 1, 0.4 + 0.02 * rng.normal(size=301), np.nan)
    sinking = {"throttle": throttle, "baro": log.pos_w[:, 2] - 5.0 * log.time_s}
    rows = rows_of(replace(log, extra=sinking))
    assert np.isnan(rows["throttle"][:, 0]).tolist() == [True] + [False] * 300
    (finding,) = check_barometer(rows)
    assert finding.status == "not identifiable" and "no row before" in finding.evidence
    assert "throttle" not in rows_of(replace(log, extra={"throttle": np.full(301, np.nan)}))


def test_a_long_pause_of_the_rows_has_a_note():
    log = flown()
    for pause_s, notes in ((4.0, 0), (60.0, 1)):
        paused = replace(log, time_s=log.time_s + pause_s * (log.time_s > 1.5))
        found = [f for f in check_log(paused)[0] if f.signal == "rows"]
        assert len(found) == notes
        assert all(f.status == "note" and "none for 60 s after" in f.evidence for f in found)


def test_a_copy_of_a_flight_is_refused(tmp_path):
    """One copy could be held out to test the fit to the other."""
    log = flown()
    rounded = replace(log, name="copy", rate_b=np.round(log.rate_b, 6))
    with pytest.raises(ValueError, match=f"{log.name} and copy are the same flight"):
        check_flights([log, flown(1.5, 4.0), rounded], CheckContext())
    unknown = replace(log, rate_b=np.full_like(log.rate_b, np.nan))
    moved = replace(unknown, pos_w=log.pos_w + [0.0, 0.0, 1.0])
    check_flights([log, unknown, moved], CheckContext(), list(FAULTS))


def test_rows_in_bursts_are_one_fault():
    """Their median step is far below the mean one: usual steps may seem to be jumps."""
    log = flown(4.0)
    place = np.arange(len(log.time_s))
    last = np.minimum(place // 4 * 4 + 3, len(place) - 1)
    log = replace(log, time_s=log.time_s[last] + 1e-4 * (place % 4))
    found, _ = check_log(log, CheckContext(PLAIN))
    assert [finding.fault for finding in found if finding.is_open] == ["clock_jitter"]


def test_logs_of_two_vehicles_are_refused_and_a_log_without_a_name_is_not():
    flights = [flown(1.5, begin_s) for begin_s in (0.0, 2.0, 4.0)]
    logs = [
        replace(log, name=f"{k}.csv", about={"vehicle": "other" if k == 2 else "mine"})
        for k, log in enumerate(flights)
    ]
    with pytest.raises(ValueError, match="of vehicle 'other'; 2 of 3 logs are of 'mine'") as error:
        check_flights(logs, CheckContext())
    assert logs[2].name in str(error.value) and "--accept vehicle_mixed" in str(error.value)
    records = check_flights(logs, CheckContext(), ["vehicle_mixed"])
    assert [r["flight"] for r in records if r["fault"] == "vehicle_mixed"] == [logs[2].name]
    # Commands that accept a fault, such as `suite identify --sensors`, warn.
    (warning,) = lines_of([r for r in records if r["fault"] == "vehicle_mixed"])
    assert warning.startswith(logs[2].name) and "vehicle 'other'" in warning
    check_flights([*logs[:2], replace(logs[2], about={})], CheckContext())
    # Flights before a change may be of a vehicle file with another name.
    check_flights(logs[:2], CheckContext(), earlier=logs[2:])


@pytest.mark.parametrize(
    ("rows", "moved_m", "status"),
    [
        (slice(150, None), 4.2, "doubt"),
        (slice(150, 151), 0.9, "doubt"),
        (slice(150, 151), 0.2, "note"),
    ],
)
@pytest.mark.parametrize("missing", [slice(0), slice(140, 150)])
def test_a_jump_of_the_position_is_named(rows, moved_m, status, missing):
    log = flown(begin_s=0.5)
    assert not check_jumps(log.time_s, log.pos_w)
    pos = log.pos_w.copy()
    pos[rows] += [moved_m, 0.0, 0.0]
    pos[missing] = np.nan
    found = [f for f in check_log(replace(log, pos_w=pos))[0] if "it jumps" in f.evidence]
    assert [(f.status, f.is_open) for f in found] == [(status, status == "doubt")]
    at_s = float(found[0].evidence.partition("t = ")[2].split(" s")[0])
    assert at_s == pytest.approx(log.time_s[150], abs=0.12)


@pytest.mark.parametrize("held", [10, 20])
def test_a_slow_position_that_is_held_in_fast_rows_does_not_jump(held):
    time_s = np.arange(0.0, 8.0, 0.01)
    pos = np.column_stack([3.0 * np.sin(2.0 * time_s), 3.0 * np.cos(2.0 * time_s), 0.0 * time_s])
    slow = np.repeat(pos[::held], held, axis=0)
    for rows in (slow, np.concatenate([pos[:400], slow[400:]])):
        assert not check_jumps(time_s, rows)
    assert not check_jumps(np.append(time_s, time_s[-1]), np.append(pos, pos[-1:], axis=0))


def test_a_velocity_in_body_axes_is_turned_right_where_a_missing_attitude_changes_its_sign():
    angle = 2.0 * np.arange(0.0, 4.0, 0.005)
    quat = np.stack([np.cos(angle / 2), 0 * angle, 0 * angle, np.sin(angle / 2)], axis=1)
    quat = np.where(quat[:, :1] < 0.0, -quat, quat)  # one sign of w, as many programs write
    log, forward_w = flight_at_rest(angle / 2.0), rotate(quat, np.array([1.0, 0.0, 0.0]))
    seen = np.where(np.arange(len(angle))[:, None] % 2, np.nan, quat)
    log = replace(log, quat_wxyz=seen, vel_w=np.zeros_like(forward_w) + [1.0, 0.0, 0.0])
    fixed = with_fixes(log, parse_readings(["vel=from-body"])).vel_w
    np.testing.assert_allclose(fixed[:-1], forward_w[:-1], atol=1e-9)


def test_another_vehicles_name_is_a_note_and_an_implausible_file_is_in_doubt():
    log = replace(part_of(without_fault(), 0.0, 3.0), about={"vehicle": "other"})
    fast = replace(PLAIN, rotors=replace(PLAIN.rotors, speed_max=10.0 * PLAIN.rotors.speed_max))
    texts = [f.evidence for f in check_log(log, CheckContext(fast))[0] if f.status == "note"]
    assert "not checked against the weight: the vehicle file is in doubt" in texts
    assert f"the log names the vehicle 'other', and --vehicle is {PLAIN.name!r}" in texts


def test_the_rate_of_slow_commands_is_that_of_their_own_rows():
    log = flown()
    has_command = np.arange(len(log.time_s)) % 5 == 0
    held = np.repeat(log.rate_cmd_b[::10], 10, axis=0)[: len(log.time_s)]
    slow = replace(log, rate_cmd_b=np.where(has_command[:, None], held, np.nan))
    row_hz = 1.0 / float(np.median(np.diff(log.time_s)))

    def status(policy_hz):
        found = check_log(slow, CheckContext(policy_hz=policy_hz))[0]
        return [one.status for one in found if one.signal == "controller"]

    assert status(row_hz / 10) == ["ok"] and status(row_hz / 5) == ["doubt"]


@pytest.mark.parametrize("per_s", [1.0, 1e3])
def test_a_wrong_unit_of_time_hides_no_jump_and_is_no_other_rate(per_s):
    log = flown(4.0)
    pos_w = log.pos_w + [3.0, 0.0, 0.0] * (log.time_s > 2.0)[:, None]
    held = np.repeat(log.rate_cmd_b[::10], 10, axis=0)[: len(log.time_s)]
    row_hz = 1.0 / float(np.median(np.diff(log.time_s)))
    log = replace(log, time_s=per_s * log.time_s, pos_w=pos_w, rate_cmd_b=held)
    found, _ = check_log(log, CheckContext(policy_hz=row_hz / 10), True)
    assert [f.status for f in found if f.signal == "controller"] == ["ok"]
    assert ["position_jump"] == [f.fault for f in found if f.is_open]


def test_a_log_that_is_too_slow_to_check_has_no_clean_bill(tmp_path, capsys):
    log = flown(8.0)
    every = round(0.2 / float(np.median(np.diff(log.time_s))))
    columns = {name: value[::every] for name, value in columns_from_log(log).items()}
    path = write_flight(tmp_path / "slow.csv", log_from_columns(columns, {}, "slow"))
    run(Config((path,), out=tmp_path / "unused"), Console())
    said = "".join(capsys.readouterr())
    assert "not checked" in said and "no fault found" not in said
    assert "nothing is written without --fix" in said


def test_the_page_has_every_fault_by_its_symptom():
    page = (ROOT / "docs/check.md").read_text(encoding="utf-8")
    assert [name for name in FAULTS if f"`{name}`" not in page] == ["file"]  # a message of its own

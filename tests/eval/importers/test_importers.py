"""An import as a whole: formats are detected, recordings become checked logs or are refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval.importers import import_log
from eval.importers.assemble import assemble, usable_for
from eval.importers.formats import FORMATS, detect
from eval.importers.mapping import check_angles
from eval.importers.options import ImportOptions
from eval.importers.signals import Recording, Signal
from eval.logs.columns import FlightLogError
from eval.logs.faults.finding import Finding, finding_lines
from eval.logs.flight_log import read_flight, write_flight
from tests.support import foreign_logs as made
from tests.support import known_flight
from tests.support.imported import NAMES, flight, near, text, write
from tests.support.log_tables import write_table
from tests.support.marks import more
from tests.support.vehicles import PLAIN

FULL = ImportOptions(full_thrust=30.0)


def test_an_import_is_written_read_back_and_keeps_what_it_says_of_itself(tmp_path):
    log, _ = import_log(made.write_usd(tmp_path / "log00"), None, FULL)
    again = read_flight(write_flight(tmp_path / "flight.parquet", log))
    np.testing.assert_array_equal(again.pos_w, log.pos_w)
    assert again.about["imported_from"] == "log00" and again.about["findings"]
    others = {"baro": np.linspace(0.0, 1.0, len(log.time_s)), "gate": np.arange(len(log.time_s))}
    log = replace(log, extra={**log.extra, **others, "note": np.full(len(log.time_s), "a")})
    told = {"integrator": "euler", "step_s": 0.002, "seed": 7, "partial": ["motor"]}
    path = write_flight(tmp_path / "ours.parquet", replace(log, about={**log.about, **told}))
    again, _ = import_log(path)
    assert (again.integrator, again.step_s, again.about["seed"]) == ("euler", 0.002, 7)
    for column, values in others.items():
        np.testing.assert_array_equal(again.extra[column], values[-len(again.time_s) :])
    assert again.partial == () and again.about["source"] == log.about["source"]


def test_a_source_is_asked_of_what_knows_of_sources(tmp_path):
    asked = replace(FULL, source="mocap")
    ours = write_flight(tmp_path / "ours.csv", import_log(made.write_usd(tmp_path / "log00"))[0])
    with pytest.raises(ValueError, match="--source mocap: the mapping of .* names no source"):
        import_log(ours, None, asked)
    with pytest.raises(ValueError, match="'px4', which has one source of the pose: leave --source"):
        import_log(made.write_ulog(tmp_path / "log.ulg"), None, asked)


LOGS = Path(__file__).resolve().parents[4] / "shared" / "real_logs"


@pytest.mark.skipif(not LOGS.is_dir(), reason="the logs are not on this machine")
@pytest.mark.parametrize(
    ("path", "lacks", "length_s"),
    [
        ("nanobench/B8_star_fast_rep2.csv", (), (28.0, 40.0)),
        ("crazypad/motor/add_weight_W3_near_M3__E9_log00", ("quat", "rate"), (20.0, 24.0)),
        ("crazypad/controller/add_weight_W3_near_M3__E9_log01", ("quat",), (20.0, 24.0)),
        ("crazyswarm2/log10", (), (2.0, 60.0)),
    ],
)
def test_published_logs_are_read_by_their_shipped_mappings(path, lacks, length_s):
    name = path.split("/")[0]
    log, _ = import_log(LOGS / path, None, ImportOptions(map=Path(name), partial=bool(lacks)))
    assert log.partial == lacks and length_s[0] < log.duration_s < length_s[1]
    if name == "crazyswarm2":  # thrust in newtons, by the mass in the file beside it
        assert log.thrust_cmd is not None and log.torque_cmd_b is not None
        np.testing.assert_allclose(log.thrust_cmd, log.extra["cmd_force"] / 0.0333)
        return
    assert log.pwm is not None
    if name == "crazypad":  # the weight hangs near rotor 3
        assert np.argmax(np.nanmean(log.pwm, axis=0)) == 2
        return
    # M1 and M3 turn counter-clockwise: more of them yaws the body clockwise.
    change = np.gradient(log.rate_b, log.time_s, axis=0)
    one, two, three, four = log.pwm.T
    drives = (three + four - one - two, two + three - one - four, two + four - one - three)
    for axis, drive in enumerate(drives):
        both = np.isfinite(drive[:-3]) & np.isfinite(change[3:, axis])
        assert np.corrcoef(drive[:-3][both], change[3:, axis][both])[0, 1] > 0.15


@pytest.mark.parametrize(
    ("signal", "late", "words"),
    [
        more("rate", False, "gyro: ends at 4.0 s; 4.0 s of other signals left out"),
        ("pos", True, "position: begins at 4.0 s; 4.0 s of other signals left out"),
    ],
)
def test_a_signal_that_ends_early_or_begins_late_has_a_note(tmp_path, signal, late, words):
    parts = flight()
    keep = (parts["time"] >= 4.0) == late
    _, findings = import_log(write(tmp_path / "log.csv", parts, {signal: keep}))
    assert any(words in line for line in finding_lines(findings))
    _, findings = import_log(write(tmp_path / "log.csv", parts))
    assert not any("other signals" in line for line in finding_lines(findings))


def test_positions_that_stand_still_in_flight_are_left_out(tmp_path):
    parts = flight()
    lost = (parts["time"] > 3.0) & (parts["time"] < 3.5)
    parts["pos"][lost] = parts["pos"][lost][0]
    log, findings = import_log(write(tmp_path / "log.csv", parts))
    assert "stand still while the gyro turns" in text(findings, "position")
    assert not [f for f in findings if f.status == "doubt"]
    assert np.isnan(log.pos_w[(log.time_s > 3.05) & (log.time_s < 3.45)]).all()
    # Of an attitude that never turns nothing would be left, so it is kept and in doubt.
    parts = flight()
    parts["quat"][:] = [1.0, 0.0, 0.0, 0.0]
    log, findings = import_log(write(tmp_path / "still.csv", parts))
    assert [f.signal for f in findings if f.is_open] == ["attitude"]
    assert np.nanmax(log.pos_w) == pytest.approx(np.max(parts["pos"]), abs=0.05)
    # A slow pose that is held in fast rows was never lost.
    parts, hold = flight(), 25
    for name in ("pos", "vel"):
        parts[name] = np.repeat(parts[name][::hold], hold, axis=0)[: len(parts["time"])]
    _, findings = import_log(write(tmp_path / "held.csv", parts))
    assert "repeat the one before" in text(findings, "position")


@pytest.mark.parametrize(
    ("columns", "unit", "words"),
    [
        (["yaw", "pitch", "roll"], "rad", "the columns are yaw, pitch, roll"),
        more(["pitch", "roll", "yaw"], "rad", "the columns are pitch, roll, yaw"),
        (["roll", "pitch", "yaw"], "deg", "the angles are in rad, read as deg"),
        (["roll", "pitch", "yaw"], "rad", ""),
    ],
)
def test_order_and_unit_of_euler_angles_are_found(tmp_path, columns, unit, words):
    parts = flight(end=6.0)
    angles = Rotation.from_quat(parts["quat"], scalar_first=True).as_euler("ZYX")[:, ::-1]
    table = dict(zip(["roll", "pitch", "yaw"], angles.T, strict=True)) | {"time": parts["time"]}
    mapping = f'[euler]\ncolumns = {columns}\nunit = "{unit}"\n[time]\ncolumn = "time"\n'
    for name, names in NAMES.items():
        if name not in ("quat", "cmd_thrust"):
            table |= dict(zip(names, parts[name].T, strict=True))
            mapping += f"[{name}]\ncolumns = {names}\n"
    path = write_table(tmp_path / "log.csv", table)
    (tmp_path / "map.toml").write_text(mapping)
    for fix in (True, False):
        log, findings = import_log(
            path, "table", ImportOptions(map=tmp_path / "map.toml", fix=fix, partial=True)
        )
        wrong = [f for f in findings if f.status in ("corrected", "doubt")]
        is_order = "columns are" in words
        assert [f.status for f in wrong][:1] == (
            [] if not words else ["corrected" if fix and is_order else "doubt"]
        )
        assert not words or words in wrong[0].evidence
        if fix and (is_order or not words):
            assert len(wrong) == bool(words)
            near(np.abs(log.quat_wxyz), np.abs(known_flight.fly(log.time_s).quat), 0.01)


def test_right_angles_are_kept_next_to_a_gyro_in_another_unit():
    """Small angles in a wrong unit look like it."""
    clock = np.arange(0.0, 8.0, 0.01)
    truth = known_flight.fly(clock)
    angles = Rotation.from_quat(truth.quat, scalar_first=True).as_euler("ZYX")[:, ::-1]

    def quat_of(value):
        return Rotation.from_euler("ZYX", value[:, ::-1]).as_quat(scalar_first=True)

    for factor in (np.pi / 180.0, 1.0, 180.0 / np.pi):
        gyro = Signal(clock, factor * truth.rate)
        assert check_angles(Signal(clock, angles), quat_of, gyro, True) == (None, [])


def test_a_pose_file_without_a_time_is_described_with_pose_map(tmp_path):
    parts = flight()
    path = write(tmp_path / "log.csv", parts)
    pose = write_table(tmp_path / "pose.csv", {"t": parts["time"]})
    with pytest.raises(FlightLogError, match="describe the columns with --pose-map"):
        import_log(path, "table", ImportOptions(pose=pose))


def test_unknown_formats_and_files(tmp_path):
    with pytest.raises(ValueError, match="Did you mean 'px4'"):
        import_log(tmp_path / "x", "px")
    with pytest.raises(FlightLogError, match="cannot be read"):
        import_log(tmp_path / "none.ulg")
    noise = tmp_path / "noise.bin"
    noise.write_bytes(bytes(range(256)) * 40)
    for name in (None, *FORMATS):
        with pytest.raises(FlightLogError, match=r"noise\.bin"):
            import_log(noise, name)


def test_each_format_is_told_by_its_first_bytes(tmp_path):
    table = write(tmp_path / "table.csv", flight(end=1.5))
    (tmp_path / "log.bin").write_bytes(b"\xa3\x95\x80\x80\x59FMT")
    files = {
        "ardupilot": tmp_path / "log.bin",
        "px4": made.write_ulog(tmp_path / "log.ulg", span=(0, 2)),
        "betaflight": made.write_blackbox(tmp_path / "log.csv", span=(0, 2)),
        "crazyflie": made.write_usd(tmp_path / "log00", span=(0, 2)),
        "mcap": made.write_mcap(tmp_path / "log.mcap", span=(0, 2)),
        "table": table,
    }
    for name, path in files.items():  # by what is in it, whatever it is called
        assert detect(path.rename(tmp_path / "renamed"), ImportOptions()) == name
    assert files.keys() == set(FORMATS)


def recording(**left_out):
    parts = flight(end=2.0)
    signals = {
        name: Signal(parts["time"], value)
        for name, value in parts.items()
        if name != "time" and name not in left_out
    }
    return Recording("log.bin", signals, about={"firmware": "made up"})


def test_a_recording_becomes_a_log_that_says_where_it_is_from():
    made_up = recording()
    made_up.about["vehicle"] = "other"
    log, findings = assemble(made_up, "made", ImportOptions(vehicle=PLAIN))
    parts = flight(end=2.0)
    np.testing.assert_allclose(log.pos_w, parts["pos"], atol=1e-12)
    assert log.thrust_cmd is not None
    np.testing.assert_allclose(log.thrust_cmd, parts["cmd_thrust"][:, 0], atol=1e-12)
    known = [log.about[key] for key in ("firmware", "source", "imported_from", "vehicle")]
    assert known == ["made up", "made", "log.bin", "plain"]
    assert log.about["findings"] == [finding._asdict() for finding in findings]
    assert any("names the vehicle 'other'" in finding.evidence for finding in findings)


@pytest.mark.parametrize(("scale", "known"), [(1.0, False), (1e3, False), (1.0, True)])
def test_a_slow_pose_leaves_the_unit_of_time_to_faster_signals(scale, known):
    parts = flight(end=30.0)
    time_s = parts.pop("time") * scale
    rows = {name: slice(None, None, 100 if name in ("pos", "quat") else 1) for name in parts}
    signals = {n: Signal(time_s[rows[n]], value[rows[n]]) for n, value in parts.items()}
    if known:  # no faster signal
        signals = {name: signals[name] for name in ("pos", "quat")}
    asked = ImportOptions(vehicle=PLAIN, partial=True, fix=False)
    log, findings = assemble(Recording("log", signals, has_seconds=known), "made", asked)
    assert log.duration_s == pytest.approx(29.5)
    assert ("time_unit" in {f.fault for f in findings}) is (scale != 1.0)


def test_start_and_end_cut_more_than_the_time_on_the_ground():
    parts = dict(recording().signals)
    del parts["cmd_thrust"], parts["cmd_rate"]
    time_s = parts["pos"].time_s
    flying = (time_s > 0.4) & (time_s < 1.7)
    height = np.where(flying, 1.0, 0.0)[:, None] * [0.0, 0.0, 1.0]
    parts["pos"] = Signal(time_s, height)
    parts["motor"] = Signal(time_s, np.where(flying, 800.0, 50.0)[:, None] * np.ones(4))
    asked = ImportOptions(fix=False, start_s=0.1, end_s=1.6)
    log, findings = assemble(Recording("log", parts), "made", asked)
    assert any("before take-off and the" in f.evidence for f in findings)
    assert log.rotor_speed is not None and log.rotor_speed.min() > 400.0
    assert log.duration_s == pytest.approx(1.2, abs=0.05)
    with pytest.raises(
        FlightLogError, match="no two rows between --start and --end; .* first sample"
    ):
        assemble(Recording("log", parts), "made", replace(asked, start_s=50.0, end_s=60.0))
    kept, _ = assemble(Recording("log", parts), "made", replace(asked, trim=False))
    assert kept.duration_s == pytest.approx(1.5, abs=0.02)
    near(kept.rate_b, known_flight.fly(kept.time_s + 0.1).rate, 1e-6)


def test_start_counts_from_the_files_first_sample_and_not_from_the_poses():
    parts = flight(end=8.0)
    time_s = parts.pop("time")
    rows = {name: slice(600 if name in ("pos", "quat") else 0, None) for name in parts}
    signals = {n: Signal(time_s[rows[n]], value[rows[n]]) for n, value in parts.items()}
    log, _ = assemble(Recording("log", signals), "made", ImportOptions(start_s=4.0, end_s=6.0))
    near(log.pos_w, known_flight.fly(log.time_s + 4.0).pos, 1e-9)
    assert log.duration_s == pytest.approx(2.0, abs=0.01)


def test_readings_come_before_a_pose_is_aligned_and_unused_ones_are_noted(tmp_path):
    parts = flight()
    truth, time_s = known_flight.fly(np.arange(1, 7, 0.01)), parts["time"] * 1e3
    pose = {"time": truth.time, "pos": truth.pos, "quat": truth.quat[:, [1, 2, 3, 0]]}
    for name in ("pos", "quat", "vel"):
        del parts[name]
    read = (("time", "ms"), ("quat", "xyzw"), ("motor", "0.5"))
    options = ImportOptions(pose=write(tmp_path / "pose.csv", pose), read=read, fix=False)
    log, findings = import_log(write(tmp_path / "log.csv", parts | {"time": time_s}), None, options)
    near(log.rot_w, known_flight.fly(log.time_s + 1.0).rot, 1e-4)
    assert "--read motor=0.5 is not used: the log has no motor" in text(findings, "file")


@pytest.mark.parametrize(
    ("missing", "reason"),
    [
        (["rate"], r"log\.bin: holds no gyro; --partial keeps"),
        (["pos", "quat"], "holds no position and no attitude; --pose FILE adds"),
        (["cmd_thrust"], "neither a thrust and rate command nor motor"),
    ],
)
def test_what_a_log_needs_is_asked_for(missing, reason):
    with pytest.raises(FlightLogError, match=reason):
        assemble(recording(**dict.fromkeys(missing)), "made", ImportOptions())


def test_a_partial_log_keeps_what_is_there_and_says_what_can_be_asked(tmp_path):
    parts = flight(end=2.0)
    lone = recording(quat=None, cmd_rate=None)
    with pytest.raises(FlightLogError, match="no attitude"):
        assemble(lone, "made", ImportOptions())
    log, findings = assemble(lone, "made", ImportOptions(partial=True))
    assert log.partial == ("quat", "command")
    assert np.isnan(log.quat_wxyz).all()
    np.testing.assert_allclose(log.rate_b, parts["rate"], atol=1e-12)
    said = [finding for finding in findings if finding.signal == "partial"]
    assert "the vertical force" in said[0].evidence
    write_flight(tmp_path / "log.parquet", log)
    with pytest.raises(FlightLogError, match="a partial log, without quat, command"):
        read_flight(tmp_path / "log.parquet")
    back = read_flight(tmp_path / "log.parquet", partial=True)
    np.testing.assert_array_equal(back.thrust_cmd, log.thrust_cmd)
    assert back.partial == log.partial


def test_the_serious_come_first_and_the_rest_in_order():
    findings = (
        Finding("ok", "units", "as they should be"),
        Finding("note", "rows", "at 100 Hz"),
        Finding("doubt", "velocity", "is off"),
        Finding("note", "motors", "put in order"),
        Finding("corrected", "attitude", "is xyzw"),
    )
    signals = [line.split()[1] for line in finding_lines(findings)]
    assert signals == ["attitude:", "velocity:", "rows:", "motors:", "units:"]


def test_motor_commands_and_positions_tell_weight_and_balance():
    rows = {"pos": np.zeros((3, 3)), "pwm": np.zeros((3, 4))}
    text = usable_for(rows, ["quat", "rate"]).evidence
    assert "balance of the rotors in hover" in text and "its torque" not in text
    alone = usable_for({"pos": rows["pos"]}, ["quat", "rate", "command"])
    assert alone.evidence.endswith("only its path")

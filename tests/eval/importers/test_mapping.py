"""Tables of any columns, units and frames become ours by a mapping; wrong mappings are refused."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pa_parquet
import pytest
from scipy.spatial.transform import Rotation

from eval.importers import import_log
from eval.importers.formats import table
from eval.importers.mapping_file import MIXERS, SHIPPED, Column, LogMap, map_file, read_map
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from eval.logs.faults.reading import parse_readings
from tests.support import known_flight
from tests.support.imported import TRUE, flight, near, same_flight, text, write
from tests.support.marks import more
from tests.support.vehicles import PLAIN
from tracks.common.toml_table import shipped_names

POSE = 'pos = {column = "p"}\nquat = {column = "q", order = "xyzw"}\n'
GRAVITY = np.array([0.0, 0.0, 9.81])


def cells(values):
    return ["[" + " ".join(repr(float(v)) for v in row) + "]" for row in values]


def imported(tmp_path, mapping, columns, **options):
    """The log of a CSV with `columns` (texts) under `mapping`."""
    rows = [",".join(columns)]
    rows += [",".join(row) for row in zip(*columns.values(), strict=True)]
    (tmp_path / "log7.csv").write_text("\n".join(rows) + "\n")
    times = "" if "time = " in mapping else 'time = {column = "t"}\n'
    (tmp_path / "map.toml").write_text(times + mapping)
    told = ImportOptions(map=tmp_path / "map.toml", **options)
    return import_log(tmp_path / "log7.csv", "table", told)


def parts(truth):
    return {
        "t": [repr(float(t)) for t in truth.time],
        "p": cells(truth.pos),
        "q": cells(truth.quat[:, [1, 2, 3, 0]]),
    }


@pytest.fixture(scope="module")
def truth():
    return known_flight.fly(np.arange(0, 4, 0.005))


def test_lists_in_cells_rates_and_accelerations_in_world_axes(tmp_path, truth):
    acc_w = np.einsum("tij,tj->ti", truth.rot, truth.acc) - GRAVITY
    columns = parts(truth) | {
        "w": cells(np.einsum("tij,tj->ti", truth.rot, truth.rate)),
        "a": cells(acc_w / 9.81),
        "u": cells(np.full((len(truth.time), 4), 0.5) * 65535),
    }
    mapping = f"""{POSE}
rate = {{column = "w", axes = "world"}}
acc = {{column = "a", unit = "g", axes = "world", gravity = "removed"}}
pwm = {{column = "u", unit = "65535"}}
"""
    log, findings = imported(tmp_path, mapping, columns)
    assert not [found for found in findings if found.status == "corrected"], "nothing to correct"
    near(log.pos_w, truth.pos, 1e-9)
    near(log.rate_b, truth.rate, 1e-6)
    near(log.acc_b, truth.acc, 1e-6)
    near(log.pwm, 0.5, 1e-12)


def test_a_thrust_in_newton_is_divided_by_the_nominal_mass(tmp_path, truth):
    columns = parts(truth) | {
        "w": cells(truth.rate),
        "f": [repr(0.5 * float(c)) for c in truth.thrust],
        "m": cells(truth.rate * 1e-3),
    }
    mapping = f"""{POSE}
rate = {{column = "w"}}
cmd_thrust = {{column = "f", unit = "N"}}
cmd_torque = {{column = "m"}}
about = {{file = "info{{number}}.yaml", mass = "mass"}}
"""
    with pytest.raises(FlightLogError, match="the mass is unknown"):
        imported(tmp_path, mapping, columns)
    (tmp_path / "info7.yaml").write_text("motors: standard\nmass: 0.5\n")
    log, _ = imported(tmp_path, mapping, columns)
    near(log.thrust_cmd, truth.thrust, 1e-9)
    near(log.torque_cmd_b, truth.rate * 1e-3, 1e-12)
    assert log.about["beside"] == {"motors": "standard", "mass": 0.5} and log.about["mass"] == 0.5
    _, findings = imported(tmp_path, mapping, columns, vehicle=PLAIN)
    assert "doubt" in (f.status for f in findings if "text file has 0.5 kg" in f.evidence)
    (tmp_path / "info7.yaml").write_text("integrator: euler\npartial: no\nmass: 0\n")
    with pytest.raises(FlightLogError, match="the mass is unknown"):
        imported(tmp_path, mapping, columns)
    other, _ = imported(tmp_path, mapping, columns, mass=0.5)
    assert other.integrator is None and not other.partial
    log, _ = imported(tmp_path, mapping, columns, vehicle=PLAIN)
    near(log.thrust_cmd, 0.5 * truth.thrust / PLAIN.mass, 1e-9)
    assert log.rate_cmd_b is None


def test_a_pose_is_of_the_source_that_is_asked_for_and_an_estimate_next_to_it_is_kept(
    tmp_path, truth
):
    off = 0.01 * np.arange(1.0, 4.0)
    columns = parts(truth) | {"e": cells(1e3 * (truth.pos + off)), "w": cells(truth.rate)}
    mapping = """
pos = [{column = "p", source = "mocap"}, {column = "e", unit = "mm", source = "estimate"}]
quat = [{column = "q", order = "xyzw", source = "mocap"},
        {column = "q", order = "xyzw", source = "estimate"}]
rate = {column = "w"}
"""
    how = {"partial": True, "trim": False, "fix": False}
    log, _ = imported(tmp_path, mapping, columns, source="estimate", **how)
    near(log.pos_w, truth.pos + off, 1e-6)
    one = mapping.replace(', source = "estimate"}]\nrate', "}]\nrate")
    _, findings = imported(tmp_path, one, columns, source="estimate", **how)
    assert "quat is of the mocap; there is none of the estimate" in text(findings, "file")
    assert not [name for name in log.extra if name.startswith("est_")]
    log, _ = imported(tmp_path, mapping, columns, **how)
    near(log.pos_w, truth.pos, 1e-9)
    for axis, value in zip("xyz", (truth.pos + off).T, strict=True):
        near(log.extra[f"est_pos_{axis}"], value, 1e-6)
    assert {f"est_quat_{a}" for a in "wxyz"} <= log.extra.keys()


def test_the_firmwares_mixer_turns_the_body_the_way_that_it_says():
    """Roll lifts the left motors, pitch (nose up) the front ones, yaw those that turn against it.

    M1 to M4 are front right, rear right, rear left, front left.
    """
    thrust, roll, pitch, yaw = MIXERS["crazyflie"].T
    assert list(thrust) == [1, 1, 1, 1]
    assert list(roll > 0) == [False, False, True, True]
    assert list(pitch > 0) == [True, False, False, True]
    assert list(yaw > 0) == [True, False, True, False]


@pytest.mark.parametrize(
    ("unit", "full", "fixed"),
    [("65535", 65535, False), ("65535", 1, False), ("1", 65535, True), ("65535", 100, True)],
)
def test_mixed_commands_are_clipped_once_their_unit_is_known(tmp_path, truth, unit, full, fixed):
    asked = np.tile([0.5, 0.1, -0.1, 0.05], (len(truth.time), 1))
    asked[100:103] = [0.9, 0.8, 0.0, 0.0], [1.2, 0.0, 0.0, 0.0], [-0.2, 0.0, 0.0, 0.0]
    pwm = f'pwm = {{column = "u", unit = "{unit}", mixer = "crazyflie"}}\n'
    columns = parts(truth) | {"u": cells(asked * full)}
    log, findings = imported(tmp_path, POSE + pwm, columns, partial=True)
    near(log.pwm, np.clip(asked @ MIXERS["crazyflie"].T, 0.0, 1.0), 1e-6)
    assert [f.status for f in findings if f.fault == "throttle_range"] == ["corrected"] * fixed


@pytest.mark.parametrize(
    ("cell", "rows", "reason"),
    [
        ("[1 2 x]", slice(4, 5), ", row 5: .*is not a list"),
        ("[1 2]", slice(4, 5), ", row 5: .*a list of 2 numbers"),
        ("1.0", slice(None), ": 1 a row .* 3 numbers; give 3 col"),
        ("[1 2]", slice(None), ": 2 a row .* 3 numbers; give 3 col"),
    ],
)
def test_broken_and_short_lists_are_refused_by_column_and_row(tmp_path, truth, cell, rows, reason):
    columns = parts(truth)
    columns["p"][rows] = [cell] * len(columns["p"][rows])
    with pytest.raises(FlightLogError, match=f"column p{reason}"):
        imported(tmp_path, POSE, columns, partial=True)


def test_a_velocity_without_an_attitude_is_left_out_and_a_mode_has_no_mean(tmp_path, truth):
    columns, half = parts(truth), len(truth.time) // 2
    columns["q"][half:] = [""] * half
    columns["v"] = [""] * (half + 20) + cells(truth.vel[half + 20 :])
    columns["mode"] = [str(2 + (k > 151)) for k in range(2 * half)]
    columns["list"] = cells(truth.pos)
    mapping = f'keep = ["mode", "list"]\n{POSE}vel = {{column = "v", axes = "body"}}\n'
    log, _ = imported(tmp_path, mapping, columns, partial=True, rate_hz=20.0)
    assert log.velocity_derived and set(log.extra["mode"]) == {2.0, 3.0}
    near(np.stack([log.extra[f"list[{k}]"] for k in range(3)], axis=1)[0], log.pos_w[0], 1e-9)


def test_the_first_time_that_is_there_counts(tmp_path, truth):
    times = 'time = [{column = "stamp"}, {column = "t"}]\n'
    log, _ = imported(tmp_path, times + POSE, parts(truth), partial=True)
    assert log.duration_s == pytest.approx(truth.time[-1] - truth.time[0], abs=0.02)


def test_unsigned_times_may_go_back_before_the_first_one():
    stamps = np.array([2, 1, 3], dtype=np.uint64) * np.uint64(10**9) + np.uint64(17 * 10**17)
    own = LogMap({"time": (Column(("time",), (1e-9,)),)})
    np.testing.assert_array_equal(
        table._time({"time": stamps}, own, "log", "")[0], [0.0, -1.0, 1.0]
    )


def test_every_shipped_mapping_is_read_by_its_name():
    names = shipped_names(SHIPPED)
    assert {"nanobench", "crazypad", "crazyswarm2", "crazyflie"} <= set(names)
    for name in names:
        assert read_map(Path(name)).motor_side is not None


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ('[pos]\ncolumn = "a"\nunit = "feet"', "pos.unit is 'feet', allowed is 'm' or 'cm'"),
        ('[frames]\nworld = "enu"', "frames.world is 'enu'"),
        ('[rate]\ncolumn = "a"\nsign = [1, -2, 1]', "1 or -1"),
        ("[volts]", "key 'volts' at the top is unknown. Did you mean 'voltage'"),
        ('[vel]\ncolumn = "a"\naxis = "body"', "Did you mean 'axes'"),
        ("[time", "is not TOML"),
        ('[pwm]\ncolumns = ["a", "b", "c"]', "pwm.columns .* 4 column names"),
        ('[rate]\ncolumns = ["a", "b", "b"]', "rate.columns .* 3 different column names"),
        ("[frames]\nmotors = [[1, 1], [1, 1], [1, -1], [-1, -1]]", r"\[\[1.0, .*different points"),
        ('[pwm]\ncolumn = "a"\nmixer = "x"', "pwm.mixer is 'x', allowed is 'crazyflie'"),
        ('[pos]\ncolumn = "a"\nscale = -1.0', "pos.scale is -1.0"),
        ("[frames]\nmotors = [[1, 1]]", "frames.motors"),
        ("[frames]\nmotors = [[1, 1], [0, 0], [1, -1], [-1, -1]]", "motors is .*off the middle"),
        ('[about]\nfile = "{log}.yaml"', "about.file is '{log}.yaml'.*but {stem} and {number}"),
        ('[about]\nfile = "{stem.yaml"', "about.file is .*but {stem} and {number}"),
        ('keep = ["other", "motor_1"]', "keep is .*not a flight log's own, as 'motor_1' is"),
    ],
)
def test_a_wrong_mapping_is_refused_by_key(tmp_path, text, reason):
    path = tmp_path / "map.toml"
    path.write_text(text + "\n")
    with pytest.raises(ValueError, match=reason):
        read_map(path)


def test_an_unknown_name_is_refused_with_the_names_there_are():
    with pytest.raises(ValueError, match="nanobench"):
        read_map(Path("nanobank"))
    for path in ("nanobank.toml", "folder/nanobank"):
        assert map_file(Path(path)) == Path(path), "a file, which may be missing"


NAMES = "time,pos_x,pos_y,pos_z,quat_w,quat_x,quat_y,quat_z,rate_x,rate_y,rate_z"
EVERYTHING = """
frames = {world = "ned", body = "frd"}
time = {column = "stamp", unit = "ns"}
pos = {columns = ["n", "e", "d"], unit = "mm"}
quat = {columns = ["qx", "qy", "qz", "qw"], order = "xyzw", maps = "world to body"}
vel = {columns = ["u", "v", "w"], axes = "body"}
rate = {columns = ["p", "q", "r"], unit = "deg/s"}
acc = {columns = ["ax", "ay", "az"], unit = "g"}
cmd_rate = {columns = ["pc", "qc", "rc"], unit = "deg/s", sign = [1, -1, 1]}
throttle = {column = "thr", unit = "%"}
motor = {columns = ["m1", "m2", "m3", "m4"], unit = "rpm"}
voltage = {column = "vbat", unit = "mV"}
"""


def _table():
    truth = known_flight.fly(np.arange(0, 8, 0.005))
    body = known_flight.ned(np.einsum("tji,tj->ti", truth.rot, truth.vel))
    inverse = known_flight.ned_quat(truth) * [1, -1, -1, -1]
    wanted = known_flight.ned(truth.cmd_rate) * [1, -1, 1]
    stamps = 1_700_000_000_000_000_000 + np.round(truth.time * 1e9).astype(np.int64)
    columns = {"stamp": stamps, "thr": truth.thrust / 0.3, "vbat": truth.voltage * 1e3}
    for names, values in (
        ("n e d", known_flight.ned(truth.pos) * 1e3),
        ("qw qx qy qz", inverse),
        ("u v w", body),
        ("p q r", np.rad2deg(known_flight.ned(truth.rate))),
        ("ax ay az", known_flight.ned(truth.acc) / 9.81),
        ("pc qc rc", np.rad2deg(wanted)),
        ("m1 m2 m3 m4", truth.motor * 60 / (2 * np.pi)),
    ):
        columns |= dict(zip(names.split(), values.T, strict=True))
    return truth, columns


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_mapped_table_equals_the_flight(tmp_path, kind):
    truth, columns = _table()
    path, mapping = tmp_path / f"log.{kind}", tmp_path / "map.toml"
    table = pa.table(columns)
    if kind == "csv":
        pa_csv.write_csv(table, path)
    else:
        pa_parquet.write_table(table, path)
    mapping.write_text(EVERYTHING)
    options = ImportOptions(map=mapping, full_thrust=30.0)
    log, findings = import_log(path, None, options)
    assert not {f.signal for f in findings if f.status in ("corrected", "doubt")}
    np.testing.assert_allclose(log.time_s, truth.time, atol=1e-9)
    same_flight(log, truth, 1e-6, **dict.fromkeys(TRUE, 1e-8))
    assert all(np.isfinite(getattr(log, name)).all() for name in TRUE)
    np.testing.assert_allclose(np.abs(np.sum(log.quat_wxyz * truth.quat, 1)), 1.0, atol=1e-12)


@pytest.mark.parametrize(
    ("unit", "span", "words"),
    [
        ("%", 65535.0, "0 to 65535"),
        more("%", 1000.0, "0 to 1000"),
        more("65535", 100.0, "percent"),
    ],
)
def test_a_throttle_in_another_unit_than_the_mapping_says_is_corrected(tmp_path, unit, span, words):
    truth, columns = _table()
    columns["thr"] = truth.thrust / 30.0 * span
    path, mapping = tmp_path / "log.csv", tmp_path / "map.toml"
    pa_csv.write_csv(pa.table(columns), path)
    mapping.write_text(EVERYTHING.replace('"thr", unit = "%"', f'"thr", unit = "{unit}"'))
    log, findings = import_log(path, None, ImportOptions(map=mapping, full_thrust=30.0))
    (found,) = (f for f in findings if f.fault == "throttle_range")
    assert found.status == "corrected" and f"goes from {words}," in found.evidence
    np.testing.assert_allclose(log.thrust_cmd, truth.thrust, rtol=1e-6)


def test_euler_angles_and_a_world_with_y_up(tmp_path):
    truth = _table()[0]
    rot = Rotation.from_euler("x", -90, degrees=True).as_matrix()  # z-up to y-up
    lying = Rotation.from_matrix(rot @ truth.rot)
    yaw, pitch, roll = lying.as_euler("ZYX", degrees=True).T
    mine = {"t": truth.time, "roll": roll, "pitch": pitch, "yaw": yaw}
    for names, values in (
        ("x y z", truth.pos @ rot.T),
        ("p q r", truth.rate),
        ("m1 m2 m3 m4", truth.motor),
    ):
        mine |= dict(zip(names.split(), values.T, strict=True))
    path, mapping = tmp_path / "log.csv", tmp_path / "map.toml"
    pa_csv.write_csv(pa.table(mine), path)
    mapping.write_text(
        'frames = {world = "y-up"}\ntime = {column = "t"}\npos = {columns = ["x", "y", "z"]}\n'
        'euler = {columns = ["roll", "pitch", "yaw"], unit = "deg"}\n'
        'rate = {columns = ["p", "q", "r"]}\nmotor = {columns = ["m1", "m2", "m3", "m4"]}\n'
    )
    log, findings = import_log(path, None, ImportOptions(map=mapping))
    assert not {f.signal for f in findings if f.status in ("corrected", "doubt")}
    np.testing.assert_allclose(log.pos_w, truth.pos, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.sum(log.quat_wxyz * truth.quat, 1)), 1.0, atol=1e-9)


def test_columns_that_are_not_there_are_refused_by_name(tmp_path):
    path, mapping = tmp_path / "log.csv", tmp_path / "map.toml"
    pa_csv.write_csv(pa.table(_table()[1]), path)
    for old, new, reason in (
        ('"p", "q", "r"', '"p", "q", "rr"', "log.csv.*column rr: missing; did you mean 'r'"),
        ("\nframes", '\nkeep = ["thrr"]\nframes', "column thrr: missing; did you mean 'thr'"),
        ('time = {column = "stamp", unit = "ns"}', "", r"name it in the mapping's \[time\]"),
    ):
        mapping.write_text(EVERYTHING.replace(old, new))
        with pytest.raises(ValueError, match=reason):
            import_log(path, None, ImportOptions(map=mapping))
    mapping.write_text('optional = "yes"\nkeep = ["thrr"]' + EVERYTHING)
    log, _ = import_log(path, None, ImportOptions(map=mapping, full_thrust=30.0))
    assert set(log.extra) == {"throttle"}


def test_text_among_numbers_is_refused_with_its_row(tmp_path):
    path = tmp_path / "log.csv"
    rows = [f"{k / 100},0,0,1,1,0,0,0,0,{'broken' if k == 7 else 0},0" for k in range(200)]
    path.write_text("\n".join([NAMES, *rows]) + "\n")
    with pytest.raises(FlightLogError, match=r"column rate_y, row 8: 'broken' is not a number$"):
        import_log(path)
    path.write_text("\n".join([NAMES, NAMES, *rows[8:]]))
    with pytest.raises(FlightLogError, match="row 1: 'time' is not a number; if this row"):
        import_log(path)
    for mark in ";\t":
        path.write_text("\n".join([NAMES, *rows]).replace(",", mark))
        with pytest.raises(FlightLogError, match="no commas; separate the columns by commas"):
            import_log(path)


def test_a_wrong_unit_of_the_time_is_named_and_unused_options_get_a_note(tmp_path):
    path = write(tmp_path / "log.csv", flight(end=12.0))
    for unit, reason in (("us", "lasts 1.2e-05 s; if .* --read time="), ("ms", "be in seconds")):
        with pytest.raises(FlightLogError, match=reason):
            import_log(path, None, ImportOptions(read=parse_readings([f"time={unit}"])))
    given = ImportOptions(mass=1.0, motor_poles=14, full_thrust=30.0)
    notes = [one.evidence for one in import_log(path, None, given).findings]
    assert sum("is not used: it is for a log with" in note for note in notes) == 3
    write(path, {name: values[:1] for name, values in flight().items()})
    with pytest.raises(FlightLogError, match="only 1 row"):
        import_log(path)


def test_dates_are_refused_as_such_and_empty_cells_are_no_lists():
    dates = {"t": np.array(["2026-01-01T00:00:01"], "M8[ns]")}
    with pytest.raises(FlightLogError, match=r"column t: a date or a span .*write it as a number"):
        table._values(dates, "t", "log")
    texts = {"names": np.array(["", None, " "], object), "lists": np.array(["[1 2]", ""], object)}
    assert np.isnan(table._values(texts, "names", "log")).tolist() == [[True]] * 3
    np.testing.assert_array_equal(table._values(texts, "lists", "log"), [[1, 2], [np.nan] * 2])

"""Flight logs come back as they were written, and bad ones are refused by name."""

import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.spatial.transform import Rotation

from eval.logs.columns import GROUPS
from eval.logs.flight_log import (
    FlightLog,
    FlightLogError,
    columns_from_log,
    log_from_columns,
    log_from_flight,
    read_flight,
    read_flights,
    write_flight,
)
from eval.logs.velocity import velocity_from_position
from tests.support.flights import small_track, smooth_flight

KINDS = ("parquet", "csv")
STATE = ("time", "pos", "quat", "rate")


def columns(rows=150, groups=(*STATE, "vel", "cmd_thrust", "cmd_rate")):
    """The columns of a well-formed log."""
    rng = np.random.default_rng(0)
    made: dict[str, np.ndarray] = {
        name: rng.normal(size=rows) for group in groups for name in GROUPS[group]
    }
    made["time"] = np.arange(rows) / 100
    quat = rng.normal(size=(rows, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return made | dict(zip(GROUPS["quat"], quat.T, strict=True))


def write_table(path, table, metadata=None):
    arrow = pa.table({name: pa.array(values) for name, values in table.items()})
    if path.suffix == ".parquet":
        pyarrow.parquet.write_table(arrow.replace_schema_metadata(metadata), path)
    else:
        pyarrow.csv.write_csv(arrow, path)
    return path


def assert_same(one: FlightLog, other: FlightLog):
    a, b = columns_from_log(one), columns_from_log(other)
    assert list(a) == list(b)
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


@pytest.mark.parametrize("kind", KINDS)
def test_our_flight_round_trips_bit_for_bit_with_its_extras(tmp_path, kind):
    flight = smooth_flight(small_track())
    log = log_from_flight(flight)
    path = write_flight(tmp_path / f"a.{kind}", log)
    back = read_flight(path)
    assert_same(log, back)
    assert back.name == str(path) and not back.warnings and not back.velocity_derived
    np.testing.assert_array_equal(back.action_b, flight.action_b)
    np.testing.assert_array_equal(back.policy_step, flight.policy_step)
    np.testing.assert_array_equal(back.gate, flight.gate)
    assert back.about["track"] == "zigzag" and back.about["seed"] == 5
    assert {"schema", "suite_version", "git_commit"} <= set(back.about)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), kind=st.sampled_from(KINDS))
def test_any_values_round_trip_to_the_last_bit(tmp_path, data, kind):
    rows = data.draw(st.integers(2, 12))
    number = st.one_of(st.floats(-190, 190), st.just(float("nan")))
    values = npst.arrays(np.float64, (rows, 18), elements=number)
    many = data.draw(values)
    many[0] = np.nan_to_num(many[0])  # a group without any value reads as one that is not there
    step = npst.arrays(np.float64, rows, elements=st.floats(1.0 / 3, 1e3))
    quat = np.tile([0.6, 0.0, -0.8, 0.0], (rows, 1))
    log = FlightLog(
        "any",
        time_s=np.cumsum(data.draw(step)) + 1.7e9 * data.draw(st.booleans()) + rows,
        pos_w=many[:, :3],
        quat_wxyz=quat,
        vel_w=many[:, 3:6],
        rate_b=many[:, 6:9],
        rotor_speed=many[:, 9:13],
        rotor_speed_cmd=many[:, 13:17],
        voltage=many[:, 17],
    )
    if log.duration_s < 1:
        log = replace(log, time_s=log.time_s + np.arange(rows))
    back = read_flight(write_flight(tmp_path / f"any.{kind}", log))
    assert_same(log, back)
    a, b = columns_from_log(log), columns_from_log(back)
    assert all(a[name].tobytes() == b[name].tobytes() for name in a if not np.isnan(a[name]).any())


@pytest.mark.parametrize("kind", KINDS)
def test_unknown_columns_of_any_type_and_metadata_are_kept(tmp_path, kind):
    table = columns() | {"mode": np.array(["rate"] * 150), "count": np.arange(150)}
    metadata = {"flight": json.dumps({"vehicle": "x", "notes": "windy"})}
    log = read_flight(write_table(tmp_path / f"in.{kind}", table, metadata))
    assert list(log.extra) == ["mode", "count"] and set(log.extra["mode"]) == {"rate"}
    if kind == "parquet":
        assert log.about == {"vehicle": "x", "notes": "windy"}
    again = read_flight(write_flight(tmp_path / f"out.{kind}", log))
    assert_same(log, again)
    assert again.action_b is None and again.policy_step is None and again.gate is None
    foreign = replace(log, extra={"gate": np.array(["north"] * 150)})
    assert foreign.gate is None


@pytest.mark.parametrize("kind", KINDS)
def test_a_golden_file_written_by_hand_reads_as_it_says(tmp_path, kind):
    csv = (
        "time, pos_x,pos_y,pos_z,quat_w,quat_x,quat_y,quat_z,rate_x,rate_y,rate_z,"
        "motor_1,motor_2,motor_3,motor_4,temperature\n"
        "10.00,0,1,2,1,0,0,0,0.1,,-0.1,900,901,902,903,20\n"
        "10.50,0.5,1,2,1,0,0,0,0.1,NaN,-0.1,900,901,902,903,\n"
        ",9,9,9,1,0,0,0,0,0,0,900,901,902,903,21\n"
        "11.25,1.25,1,2,0.7071,0.7071,0,0,0.1,0.2,-0.1,900,901,902,903,22\n"
    )
    path = tmp_path / "golden.csv"
    path.write_text("\ufeff" + csv)
    if kind == "parquet":
        table = pyarrow.csv.read_csv(path)
        table = table.rename_columns([name.strip() for name in table.column_names])
        path = tmp_path / "golden.parquet"
        pyarrow.parquet.write_table(table, path)
    log = read_flight(path)
    np.testing.assert_array_equal(log.time_s, [10, 10.5, 11.25])
    np.testing.assert_array_equal(log.pos_w, [[0, 1, 2], [0.5, 1, 2], [1.25, 1, 2]])
    np.testing.assert_allclose(log.quat_wxyz[2], np.sqrt([0.5, 0.5, 0, 0]), rtol=1e-12)
    np.testing.assert_array_equal(log.rate_b[:, 1], [np.nan, np.nan, 0.2])
    assert log.rotor_speed is not None and log.thrust_cmd is None
    np.testing.assert_array_equal(log.rotor_speed[0], [900, 901, 902, 903])
    assert log.velocity_derived
    np.testing.assert_allclose(log.vel_w, [[1, 0, 0]] * 3, atol=1e-9)
    np.testing.assert_array_equal(log.whole, [False, False, True])
    np.testing.assert_array_equal(log.extra["temperature"], [20, np.nan, 22])
    assert log.warnings[0].startswith(f"{path}: 1 rows without a time are left out")
    assert "seconds" in log.warnings[1] and log.duration_s == 1.25


@pytest.mark.parametrize("groups", [("motor",), ("cmd_thrust", "cmd_rate"), ("motor", "acc")])
def test_motors_or_commands_alone_are_enough(groups):
    log = log_from_columns(columns(groups=(*STATE, "vel", *groups)), {}, "a")
    assert (log.rotor_speed is not None) == ("motor" in groups)
    assert (log.thrust_cmd is not None) == (log.rate_cmd_b is not None) == ("motor" not in groups)
    assert (log.acc_b is not None) == ("acc" in groups)
    assert log.whole.all()


def test_rot_w_is_body_to_world():
    log = log_from_columns(columns(), {}, "a")
    expected = Rotation.from_quat(log.quat_wxyz, scalar_first=True).as_matrix()
    np.testing.assert_allclose(log.rot_w, expected, atol=1e-12)


def spoil(name, row, value):
    def change(table):
        table[name][row] = value

    return change


def drop(name, other=None):
    def change(table):
        values = table.pop(name)
        if other:
            table[other] = values

    return change


BAD = [
    (spoil("time", 7, 0.06), "time", 8, "does not come after"),
    (spoil("time", 7, 0.01), "time", 8, "must increase"),
    (spoil("pos_y", 3, np.inf), "pos_y", 4, "infinite"),
    (spoil("vel_x", 0, -np.inf), "vel_x", 1, "infinite"),
    (spoil("cmd_rate_z", 149, np.inf), "cmd_rate_z", 150, "infinite"),
    (spoil("pos_z", 9, -100_001.0), "pos_z", 10, "100 km"),
    (spoil("rate_x", 2, 201.0), "rate_x", 3, "200 rad/s"),
    (spoil("quat_w", 5, 3.0), "quat_w", 6, "norm"),
    (drop("pos_x"), "pos_x", None, "missing"),
    (drop("pos_x", "x"), "pos_x", None, "did you mean 'x'"),
    (drop("rate_y", "Rate_Y"), "rate_y", None, "did you mean 'Rate_Y'"),
    (drop("quat_w", "qw"), "quat_w", None, "did you mean 'qw'"),
    (drop("time", "timestamp"), "time", None, "did you mean 'timestamp'"),
    (drop("vel_y"), "vel_y", None, "missing"),
    (drop("cmd_thrust"), "cmd_thrust", None, "cmd_rate_x needs it"),
    (drop("cmd_rate_y"), "cmd_rate_y", None, "missing"),
]


@pytest.mark.parametrize(("change", "column", "row", "reason"), BAD)
@pytest.mark.parametrize("kind", KINDS)
def test_a_broken_rule_is_refused_with_file_column_row_and_reason(
    tmp_path, kind, change, column, row, reason
):
    table = columns()
    change(table)
    path = write_table(tmp_path / f"bad.{kind}", table)
    with pytest.raises(FlightLogError) as caught:
        read_flight(path)
    error = caught.value
    assert (error.name, error.column, error.row) == (str(path), column, row)
    assert reason in error.reason
    assert str(path) in str(error) and column in str(error)
    assert row is None or f"row {row}" in str(error)


def test_values_at_the_limits_are_taken():
    table = columns()
    table["pos_z"][0], table["rate_x"][0] = 100e3, -200.0
    for part in GROUPS["quat"]:
        table[part][4] *= 1.049
        table[part][5] *= 0.951
    log = log_from_columns(table, {}, "a")
    np.testing.assert_allclose(np.linalg.norm(log.quat_wxyz, axis=1), 1, atol=1e-12)
    assert log.pos_w[0, 2] == 100e3


def test_rows_are_counted_as_in_the_file_where_some_have_no_time():
    table = columns()
    table["time"][:3] = np.nan
    table["rate_z"][10] = 500
    with pytest.raises(FlightLogError, match="row 11"):
        log_from_columns(table, {}, "a")


def test_less_than_a_second_no_rows_and_no_command_are_refused():
    with pytest.raises(FlightLogError, match="0.99 s of flight; at least 1 s"):
        log_from_columns(columns(rows=100), {}, "a")
    with pytest.raises(FlightLogError, match="no rows"):
        log_from_columns(columns(rows=0), {}, "a")
    with pytest.raises(FlightLogError, match="neither cmd_thrust .* motor_4"):
        log_from_columns(columns(groups=STATE), {}, "a")
    table = columns()
    table["quat_y"][:] = np.nan
    with pytest.raises(FlightLogError, match="quat_y, row 1: missing in every row"):
        log_from_columns(table, {}, "a")
    table = columns()
    table["cmd_thrust"][:] = np.nan
    with pytest.raises(FlightLogError):
        log_from_columns(table, {}, "a")


def test_files_that_are_no_logs_are_refused(tmp_path):
    good = write_table(tmp_path / "good.parquet", columns()).read_bytes()
    text = write_table(tmp_path / "good.csv", columns()).read_text()
    lines = text.splitlines()
    cases = {
        "empty.csv": (b"", "empty"),
        "cut.parquet": (good[: len(good) // 2], "corrupt Parquet"),
        "text.parquet": (b"hello", "not a Parquet"),
        "binary.csv": (bytes(range(256)), "neither a Parquet file nor CSV"),
        "semicolons.csv": (text.replace(",", ";").encode(), "commas"),
        "header.csv": (lines[0].encode() + b"\n", "no rows"),
        "word.csv": (text.replace(lines[5].split(",")[0], "oops", 1).encode(), "oops"),
        "short.csv": ("\n".join([*lines[:3], "1,2", *lines[3:]]).encode(), "row 3: 2 values"),
        "twice.csv": (text.replace('"pos_y"', '"pos_x"').encode(), "twice"),
    }
    for name, (content, reason) in cases.items():
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(FlightLogError) as caught:
            read_flight(path)
        assert reason in str(caught.value), (name, str(caught.value))
        assert str(path) in str(caught.value)
    for path in (tmp_path / "nowhere.csv", tmp_path):
        with pytest.raises(FlightLogError, match="cannot be read"):
            read_flight(path)


def test_a_last_line_that_was_cut_is_left_out_with_a_warning(tmp_path):
    path = write_table(tmp_path / "cut.csv", columns())
    path.write_text(path.read_text().rstrip("\n").rsplit(",", 3)[0])
    log = read_flight(path)
    assert len(log.time_s) == 149
    assert "row 150" in log.warnings[0] and str(path) in log.warnings[0]


def test_one_bad_flight_among_many_is_named_and_all_bad_is_an_error(tmp_path):
    good = write_table(tmp_path / "good.csv", columns())
    bad = tmp_path / "bad.csv"
    bad.write_text("time\n1\n")
    flights, warnings = read_flights([good, bad, good])
    assert [flight.name for flight in flights] == [str(good)] * 2
    assert len(warnings) == 1 and str(bad) in warnings[0] and "pos_x" in warnings[0]
    with pytest.raises(FlightLogError, match="none can be used") as caught:
        read_flights([bad])
    assert str(bad) in str(caught.value)
    with pytest.raises(FlightLogError, match="no file"):
        read_flights([])


def test_nothing_is_written_that_could_not_be_read(tmp_path):
    log = log_from_columns(columns(), {}, "a")
    with pytest.raises(FlightLogError, match="infinite"):
        write_flight(tmp_path / "a.csv", replace(log, pos_w=log.pos_w + np.inf))
    with pytest.raises(FlightLogError, match="149 values"):
        write_flight(tmp_path / "a.csv", replace(log, thrust_cmd=np.zeros(149)))
    with pytest.raises(FlightLogError, match="ending"):
        write_flight(tmp_path / "a.txt", log)
    assert not list(tmp_path.iterdir())


def test_derived_velocity_follows_a_racing_flight_over_jitter_and_holes(tmp_path):
    rng = np.random.default_rng(3)
    flight = smooth_flight(small_track(8), speed=6.0)
    keep = rng.random(len(flight.time_s)) > 0.1
    keep[100:112] = False
    table = columns_from_log(replace(log_from_flight(flight), extra={}))
    table = {name: values[keep] for name, values in table.items() if not name.startswith("vel")}
    table["pos_x"][20] = np.nan
    log = log_from_columns(table, {}, "a")
    assert log.velocity_derived
    error = np.linalg.norm(log.vel_w - flight.vel_w[keep], axis=1)
    # A spline's jerk steps at its knots, up to 400 m/s^3 here, which a cubic cannot follow.
    assert np.median(error) < 0.02 and error.max() < 0.5
    back = read_flight(write_flight(tmp_path / "a.parquet", log))
    assert back.velocity_derived
    np.testing.assert_array_equal(back.vel_w, log.vel_w)


@settings(max_examples=40)
@given(seed=st.integers(0, 10_000), rate=st.sampled_from([20, 100, 500]))
def test_derived_velocity_of_a_cubic_is_exact_at_any_sampling(seed, rate):
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.5, 1.5, 2 * rate)) / rate
    curve = np.polynomial.Polynomial(rng.normal(size=4) * [1e4, 5, 3, 1])
    pos = np.stack([curve(time), -curve(time), np.ones(len(time))], axis=1)
    slope = curve.deriv()(time)
    expected = np.stack([slope, -slope, np.zeros(len(time))], axis=1)
    np.testing.assert_allclose(velocity_from_position(time, pos), expected, atol=1e-5)


def test_derived_velocity_where_little_is_known():
    time = np.array([0.0, 1.0, 1.01, 5.0, 9.0])
    pos = np.stack([3 * time, 0 * time, 0 * time], axis=1)
    pos[1] = np.nan
    velocity = velocity_from_position(time, pos)
    assert np.isnan(velocity_from_position(time, np.full((5, 3), np.nan))).all()
    assert np.all(np.isnan(velocity[:, 0]) | (np.abs(velocity[:, 0] - 3) < 1e-9))

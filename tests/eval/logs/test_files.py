"""Columns come back as they were written; a broken rule or file is refused by name."""

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

from eval.logs import files
from eval.logs.columns import GROUPS
from eval.logs.flight_log import (
    FlightLog,
    FlightLogError,
    columns_from_log,
    log_from_columns,
    read_flight,
    write_flight,
)
from tests.support.log_tables import KINDS, STATE, assert_same, columns, write_table


@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture])
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


def test_a_column_of_numbers_with_the_name_of_the_metadata_is_kept(tmp_path):
    table = columns() | {"flight": np.arange(150)}
    for kind in KINDS:
        log = read_flight(write_table(tmp_path / f"in.{kind}", table))
        assert log.extra["flight"].tolist() == list(range(150)) and log.about == {}
    again = read_flight(write_flight(tmp_path / "out.parquet", log))
    assert again.extra["flight"].tolist() == list(range(150)) and again.about["schema"] == 1
    with pytest.raises(FlightLogError, match="column flight: CSV keeps this name"):
        write_flight(tmp_path / "out.csv", log)


def test_files_that_are_no_logs_are_refused(tmp_path):
    good = write_table(tmp_path / "good.parquet", columns()).read_bytes()
    text = write_table(tmp_path / "good.csv", columns()).read_text()
    lines = text.splitlines()
    cases = {
        "empty.csv": (b"", "empty"),
        "cut.parquet": (good[: len(good) // 2], "corrupt Parquet"),
        "text.parquet": (b"hello", "not a Parquet"),
        "binary.csv": (bytes(range(256)), "neither a Parquet file nor CSV"),
        "mine.onnx": (b"\x08\x08", "suite check --policy"),
        "track.toml": (b"schema = 1", "a vehicle (suite check --vehicle), not a flight log"),
        "semicolons.csv": (text.replace(",", ";").encode(), "commas"),
        "header.csv": (lines[0].encode() + b"\n", "no whole rows"),
        "word.csv": (text.replace(lines[5].split(",")[0], "oops", 1).encode(), "oops"),
        "short.csv": ("\n".join([*lines[:3], "1,2", *lines[3:]]).encode(), "row 3: 2 values"),
        "twice.csv": (text.replace('"pos_y"', '"pos_x"').encode(), "twice"),
        "letters.csv": (text.encode().replace(b"1", b"\xe9", 99), "nor CSV in UTF-8"),
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


@pytest.mark.parametrize("length", [200_000, 3_000_000])
def test_a_csv_with_long_metadata_and_columns_without_a_name_is_read(tmp_path, length):
    log = log_from_columns(columns(), {"notes": "x" * length}, "a")
    path = write_flight(tmp_path / "a.csv", log)
    path.write_text(path.read_text().replace("\n", ",,\n"))
    again = read_flight(path)
    assert_same(log, again)
    assert again.about["notes"] == log.about["notes"]


def test_a_last_line_that_was_cut_is_left_out_with_a_warning(tmp_path):
    path = write_table(tmp_path / "cut.csv", columns())
    path.write_text(path.read_text().rstrip("\n").rsplit(",", 3)[0])
    log = read_flight(path)
    assert len(log.time_s) == 149
    assert "row 150" in log.warnings[0] and str(path) in log.warnings[0]


def test_nothing_is_written_that_could_not_be_read(tmp_path):
    log = log_from_columns(columns(), {}, "a")
    with pytest.raises(FlightLogError, match="infinite"):
        write_flight(tmp_path / "a.csv", replace(log, pos_w=log.pos_w + np.inf))
    with pytest.raises(FlightLogError, match="149 values"):
        write_flight(tmp_path / "a.csv", replace(log, thrust_cmd=np.zeros(149)))
    with pytest.raises(FlightLogError, match="ending"):
        write_flight(tmp_path / "a.txt", log)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", KINDS)
def test_a_log_of_too_many_rows_is_refused_unread(tmp_path, kind, monkeypatch):
    monkeypatch.setattr(files, "MOST_ROWS", 149)
    path = write_table(tmp_path / f"long.{kind}", columns(150))
    read = pyarrow.csv if kind == "csv" else pyarrow.parquet.ParquetFile
    monkeypatch.setattr(read, "read_csv" if kind == "csv" else "read", None)
    with pytest.raises(FlightLogError, match="rows; at most 149"):
        read_flight(path)


def test_of_more_cells_than_fit_only_known_columns_are_read_or_all_are_refused(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(files, "MOST_CELLS", 1000)
    table = {"time": np.zeros(400)} | {f"u{k}": np.zeros(400) for k in range(26)}
    read, _, warnings = files.read_columns(write_table(tmp_path / "wide.parquet", table))
    assert list(read) == ["time"] and "26 of 27 columns are left out" in warnings[0]
    for kind in KINDS:
        path = write_table(tmp_path / f"in.{kind}", columns())
        with pytest.raises(FlightLogError, match=r"15. rows of \d+ columns; at most 1,000"):
            read_flight(path)
    path = write_table(tmp_path / "in.parquet", {"a": np.zeros(600), "b": np.zeros(600)})
    with pytest.raises(FlightLogError, match="600 rows of 2 columns; at most 1,000 cells"):
        read_flight(path)


def test_out_of_memory_is_said_as_such(tmp_path, monkeypatch):
    path = write_table(tmp_path / "in.parquet", columns())

    def read(self, *args, **kwargs):
        raise pa.ArrowMemoryError("realloc of size 12600000000 failed")

    monkeypatch.setattr(pyarrow.parquet.ParquetFile, "read", read)
    with pytest.raises(MemoryError):
        read_flight(path)


def test_texts_stay_coded_and_lists_are_left_out(tmp_path):
    mode = np.array(["x" * 2**20, None] * 75, object)
    table = columns() | {"mode": mode, "list": np.array([[1.0, 2.0]] * 150).tolist()}
    log = read_flight(write_table(tmp_path / "in.parquet", table))
    assert list(log.extra) == ["mode"] and log.extra["mode"][1] is None
    assert log.extra["mode"][0] is log.extra["mode"][2], "one text in memory for all rows"
    with pytest.raises(FlightLogError, match="pos_x: its cells hold lists"):
        read_flight(write_table(tmp_path / "in.parquet", table | {"pos_x": table["list"]}))


@pytest.mark.parametrize("groups", [("motor",), ("cmd_thrust", "cmd_rate"), ("motor", "acc")])
def test_motors_or_commands_alone_are_enough(groups):
    log = log_from_columns(columns(groups=(*STATE, "vel", *groups)), {}, "a")
    assert (log.rotor_speed is not None) == ("motor" in groups)
    assert (log.thrust_cmd is not None) == (log.rate_cmd_b is not None) == ("motor" not in groups)
    assert (log.acc_b is not None) == ("acc" in groups)
    assert log.whole.all()


def spoil(name, row, value):
    return lambda table: table[name].__setitem__(row, value)


def drop(name, other="unknown"):
    return lambda table: table.update({other: table.pop(name)})


def in_single_precision(table):
    table["time"] = (table["time"] + 2e5).astype(np.float32).astype(np.float64)


BAD = [
    (spoil("time", 7, 0.06), "time", 8, "does not come after"),
    (in_single_precision, "time", 3, "single precision"),
    (spoil("time", 7, 0.01), "time", 8, "must increase"),
    (spoil("pos_y", 3, np.inf), "pos_y", 4, "infinite"),
    (spoil("vel_x", 0, -np.inf), "vel_x", 1, "infinite"),
    (spoil("cmd_rate_z", 149, np.inf), "cmd_rate_z", 150, "infinite"),
    (spoil("pos_z", 9, -100_001.0), "pos_z", 10, "100 km"),
    (spoil("rate_x", 2, 201.0), "rate_x", 3, "200 rad/s"),
    (spoil("vel_x", 3, 1e300), "vel_x", 4, "too large for any unit"),
    (spoil("quat_w", 5, 3.0), "quat_w", 6, "norm"),
    (drop("pos_x"), "pos_x", None, "missing"),
    (drop("pos_x", "x"), "pos_x", None, "did you mean 'x'"),
    (drop("rate_y", "Rate_Y"), "rate_y", None, "did you mean 'Rate_Y'"),
    (drop("time", "timestamp"), "time", None, "did you mean 'timestamp'"),
    (drop("vel_y"), "vel_y", None, "missing"),
    (drop("cmd_thrust"), "cmd_thrust", None, "cmd_rate_x needs it"),
    (
        spoil("cmd_thrust", slice(None), np.nan),
        "cmd_thrust",
        None,
        "in every row; cmd_rate_x needs",
    ),
    (drop("cmd_rate_y"), "cmd_rate_y", None, "missing"),
]


@pytest.mark.parametrize(("change", "column", "row", "reason"), BAD)
def test_a_broken_rule_is_refused_with_file_column_row_and_reason(
    tmp_path, change, column, row, reason
):
    table = columns()
    change(table)
    for kind in KINDS:
        path = write_table(tmp_path / f"bad.{kind}", table)
        with pytest.raises(FlightLogError) as caught:
            read_flight(path)
        error = caught.value
        assert (error.name, error.column, error.row) == (str(path), column, row)
        assert reason in error.reason and str(path) in str(error) and column in str(error)
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
    # Rows are counted as in the file, where some have no time.
    table["time"][:3], table["rate_z"][10] = np.nan, 500
    with pytest.raises(FlightLogError, match="row 11"):
        log_from_columns(table, {}, "a")


def test_less_than_a_second_no_rows_and_no_command_are_refused():
    with pytest.raises(FlightLogError, match="0.99 s of flight; at least 1 s"):
        log_from_columns(columns(rows=100), {}, "a")
    with pytest.raises(FlightLogError, match="no rows"):
        log_from_columns(columns(rows=0), {}, "a")
    with pytest.raises(FlightLogError, match="neither cmd_thrust .* motor_4"):
        log_from_columns(columns(groups=STATE), {}, "a")
    motors = columns(groups=(*STATE, "motor")) | {"motor_4": np.full(150, np.nan)}
    with pytest.raises(FlightLogError, match="is there; missing in every row: motor_4"):
        log_from_columns(motors, {}, "a")
    for name in ("quat_y", "cmd_thrust"):
        with pytest.raises(FlightLogError, match=name):
            log_from_columns(columns() | {name: np.full(150, np.nan)}, {}, "a")

"""A log that breaks a rule is refused with file, column, row and reason."""

import numpy as np
import pytest

from eval.logs.columns import GROUPS
from eval.logs.flight_log import FlightLogError, log_from_columns, read_flight
from tests.support.log_tables import KINDS, STATE, columns, write_table


@pytest.mark.parametrize("groups", [("motor",), ("cmd_thrust", "cmd_rate"), ("motor", "acc")])
def test_motors_or_commands_alone_are_enough(groups):
    log = log_from_columns(columns(groups=(*STATE, "vel", *groups)), {}, "a")
    assert (log.rotor_speed is not None) == ("motor" in groups)
    assert (log.thrust_cmd is not None) == (log.rate_cmd_b is not None) == ("motor" not in groups)
    assert (log.acc_b is not None) == ("acc" in groups)
    assert log.whole.all()


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
    (spoil("vel_x", 3, 1e300), "vel_x", 4, "too large for any unit"),
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

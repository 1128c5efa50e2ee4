"""`suite import` from the command line."""

import json

import pytest

from eval.logs.flight_log import read_flight
from suite import cli
from tests.support import foreign_logs as made


def test_a_log_becomes_a_flight_log(tmp_path, capsys):
    log, out = made.write_ulog(tmp_path / "log.ulg"), tmp_path / "flight.parquet"
    code = cli.main(["import", str(log), "--out", str(out), "--full-thrust", "30"])
    said = capsys.readouterr().out
    assert code == 0 and "attitude: its derivative is off" in said
    flight = read_flight(out)
    assert f"{len(flight.time_s)} rows" in said and flight.about["source"] == "px4"


def test_json_is_one_object(tmp_path, capsys):
    log, out = made.write_usd(tmp_path / "log00"), tmp_path / "flight.csv"
    assert cli.main(["import", str(log), "--out", str(out), "--vehicle", "racer5", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["rows"] == len(read_flight(out).time_s)
    assert {"level", "subject", "text"} == set(answer["findings"][0])


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (["--out", "flight.txt"], "--out is 'flight.txt'"),
        (["--rate", "0"], "--rate is 0"),
        (["--full-thrust", "-3"], "--full-thrust is -3"),
        (["--start", "5", "--end", "2"], "0 <= start < end"),
        (["--pose-map", "m.toml"], "--pose, which is not given"),
        (["--vehicle", "racer6"], "racer5"),
        (["--format", "px5"], "px4"),
        (["--pose", "nowhere.csv"], "nowhere.csv: cannot be read"),
        (["--format", "table", "--map", "nowhere.toml"], "nowhere.toml: cannot be read"),
    ],
)
def test_bad_options_are_code_2_in_one_line(tmp_path, capsys, options, reason):
    log = made.write_usd(tmp_path / "log00", span=(0, 3))
    out = tmp_path / "flight.parquet"
    where = [] if "--out" in options else ["--out", str(out)]
    code = cli.main(["import", str(log), *where, *options])
    said = capsys.readouterr().err
    assert code == 2 and reason in said and "Traceback" not in said and not out.exists()


def test_a_log_that_is_read_is_not_written_over(tmp_path, capsys):
    log, pose = made.write_usd(tmp_path / "log00", span=(0, 3)), tmp_path / "pose.csv"
    pose.write_text("t\n")
    table = log.rename(tmp_path / "log.csv")
    for args in (
        [str(table), "--out", str(table)],
        [str(table), "--pose", str(pose), "--out", str(pose)],
    ):
        assert cli.main(["import", *args]) == 2
        assert f"{args[-1]} is read, too" in capsys.readouterr().err
    assert pose.read_text() == "t\n"

"""Tables of any columns, units and frames, through a mapping file."""

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
import pyarrow.parquet as pa_parquet
import pytest
from scipy.spatial.transform import Rotation

from eval.importers import import_log
from eval.importers.formats import table
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from tests.support import known_flight
from tests.support.imported import TRUE, same_flight

NAMES = "time,pos_x,pos_y,pos_z,quat_w,quat_x,quat_y,quat_z,rate_x,rate_y,rate_z"
MAP = """
[frames]
world = "ned"
body = "frd"
[time]
column = "stamp"
unit = "ns"
[pos]
columns = ["n", "e", "d"]
unit = "mm"
[quat]
columns = ["qx", "qy", "qz", "qw"]
order = "xyzw"
maps = "world to body"
[vel]
columns = ["u", "v", "w"]
axes = "body"
[rate]
columns = ["p", "q", "r"]
unit = "deg/s"
[acc]
columns = ["ax", "ay", "az"]
unit = "g"
[cmd_rate]
columns = ["pc", "qc", "rc"]
unit = "deg/s"
sign = [1, -1, 1]
[throttle]
column = "thr"
unit = "%"
[motor]
columns = ["m1", "m2", "m3", "m4"]
unit = "rpm"
[voltage]
column = "vbat"
unit = "mV"
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
    mapping.write_text(MAP)
    options = ImportOptions(map=mapping, full_thrust=30.0)
    log, findings = import_log(path, None, options)
    assert not {f.signal for f in findings if f.status in ("corrected", "doubt")}
    np.testing.assert_allclose(log.time_s, truth.time, atol=1e-9)
    same_flight(log, truth, 1e-6, **dict.fromkeys(TRUE, 1e-8))
    assert all(np.isfinite(getattr(log, name)).all() for name in TRUE)
    np.testing.assert_allclose(np.abs(np.sum(log.quat_wxyz * truth.quat, 1)), 1.0, atol=1e-12)


def test_euler_angles_and_a_world_with_y_up(tmp_path):
    truth, columns = _table()
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
        '[frames]\nworld = "y-up"\n[time]\ncolumn = "t"\n[pos]\ncolumns = ["x", "y", "z"]\n'
        '[euler]\ncolumns = ["roll", "pitch", "yaw"]\nunit = "deg"\n'
        '[rate]\ncolumns = ["p", "q", "r"]\n[motor]\ncolumns = ["m1", "m2", "m3", "m4"]\n'
    )
    log, findings = import_log(path, None, ImportOptions(map=mapping))
    assert not {f.signal for f in findings if f.status in ("corrected", "doubt")}
    np.testing.assert_allclose(log.pos_w, truth.pos, atol=1e-9)
    np.testing.assert_allclose(np.abs(np.sum(log.quat_wxyz * truth.quat, 1)), 1.0, atol=1e-9)
    assert columns


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('"p", "q", "r"', '"p", "q", "rr"', "log.csv.*column rr: missing; did you mean 'r'"),
        ('[time]\ncolumn = "stamp"\nunit = "ns"', "", r"name it in the mapping's \[time\]"),
    ],
)
def test_columns_that_are_not_there_are_refused_by_name(tmp_path, old, new, reason):
    path, mapping = tmp_path / "log.csv", tmp_path / "map.toml"
    pa_csv.write_csv(pa.table(_table()[1]), path)
    mapping.write_text(MAP.replace(old, new))
    with pytest.raises(ValueError, match=reason):
        import_log(path, None, ImportOptions(map=mapping))


def test_text_among_numbers_is_refused_with_its_row(tmp_path):
    path = tmp_path / "log.csv"
    rows = [f"{k / 100},0,0,1,1,0,0,0,0,{'broken' if k == 7 else 0},0" for k in range(200)]
    path.write_text("\n".join([NAMES, *rows]) + "\n")
    with pytest.raises(FlightLogError, match=r"column rate_y, row 8: 'broken' is not a number"):
        import_log(path)


def test_dates_are_refused_as_such_and_empty_cells_are_no_lists():
    dates = {"t": np.array(["2026-01-01T00:00:01"], "M8[ns]")}
    with pytest.raises(FlightLogError, match=r"column t: a date or a span .*write it as a number"):
        table._values(dates, "t", "log")
    texts = {"names": np.array(["", None, " "], object), "lists": np.array(["[1 2]", ""], object)}
    assert np.isnan(table._values(texts, "names", "log")).tolist() == [[True]] * 3
    np.testing.assert_array_equal(table._values(texts, "lists", "log"), [[1, 2], [np.nan] * 2])


def test_a_table_without_a_map_says_what_it_needs(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,x,y\n0,1,2\n1,2,3\n")
    with pytest.raises(
        FlightLogError, match=r"describe the columns with --map. There are: t, x, y"
    ):
        import_log(path)

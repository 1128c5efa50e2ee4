"""Columns of a well-formed flight log, and the files that hold them."""

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet

from eval.logs.columns import GROUPS
from eval.logs.flight_log import FlightLog, columns_from_log

KINDS = ("parquet", "csv")
STATE = ("time", "pos", "quat", "rate")


def columns(rows=150, groups=(*STATE, "vel", "cmd_thrust", "cmd_rate")):
    """Return the columns of a well-formed log."""
    rng = np.random.default_rng(0)
    made: dict[str, np.ndarray] = {
        name: rng.normal(size=rows) for group in groups for name in GROUPS[group]
    }
    made["time"] = np.arange(rows) / 100
    quat = rng.normal(size=(rows, 4))
    quat /= np.linalg.norm(quat, axis=1, keepdims=True)
    return made | dict(zip(GROUPS["quat"], quat.T, strict=True))


def level(time_s, **columns):
    """Return the log of a level body at rest; `columns` are further signals, or others."""
    still, up = np.zeros((len(time_s), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(time_s), 1))
    rest = {"time_s": time_s, "pos_w": still, "quat_wxyz": up, "vel_w": still, "rate_b": still}
    return FlightLog("level", **{**rest, **columns})


def write_table(path, table, metadata=None):
    """Write the columns as they are to a file of either kind; return its path."""
    arrow = pa.table({name: pa.array(values) for name, values in table.items()})
    if path.suffix == ".parquet":
        pyarrow.parquet.write_table(arrow.replace_schema_metadata(metadata), path)
    else:
        pyarrow.csv.write_csv(arrow, path)
    return path


def assert_same(one: FlightLog, other: FlightLog):
    """Two logs are equal to the last bit."""
    a, b = columns_from_log(one), columns_from_log(other)
    assert list(a) == list(b)
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)

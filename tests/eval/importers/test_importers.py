"""An import as a whole: what is read can be written, and is cut where that is asked for."""

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from eval.logs.flight_log import read_flight, write_flight
from tests.support import foreign_logs as made
from tests.support import known_flight
from tests.support.imported import near

FULL = ImportOptions(full_thrust=30.0)


def test_an_import_can_be_written_and_read_back(tmp_path):
    log, _ = import_log(made.write_usd(tmp_path / "log00"), None, FULL)
    again = read_flight(write_flight(tmp_path / "flight.parquet", log))
    np.testing.assert_array_equal(again.pos_w, log.pos_w)
    assert again.about["imported_from"] == "log00" and again.about["findings"]


def test_start_and_end_cut_the_flight(tmp_path):
    path = made.write_usd(tmp_path / "log00")
    log, _ = import_log(path, None, ImportOptions(full_thrust=30.0, start_s=2.0, end_s=5.0))
    assert log.duration_s == pytest.approx(3.0, abs=0.02)
    near(log.pos_w, known_flight.fly(log.time_s + 2.0).pos, 1e-5)
    with pytest.raises(FlightLogError, match="no time at which"):
        import_log(path, None, ImportOptions(start_s=50.0))

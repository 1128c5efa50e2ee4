"""A file of no known format is refused by its name, whatever is in it."""

import numpy as np
import pytest

from eval.importers import import_log
from eval.importers.formats import FORMATS, detect
from eval.importers.options import ImportOptions
from eval.logs.columns import FlightLogError
from tests.support import foreign_logs as made
from tests.support.imported import flight, write


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


def test_any_bytes_are_refused_without_a_crash(tmp_path):
    rng = np.random.default_rng(3)
    heads = [b"ULog\x01\x12\x35\x01", b"\xbc\x02\x00\x01\x00", b"\x89MCAP0\r\n", b"PAR1", b"time,"]
    for k in range(40):
        path = tmp_path / f"file{k}"
        path.write_bytes(heads[k % len(heads)] + rng.bytes(int(rng.integers(0, 400))))
        with pytest.raises(FlightLogError, match=path.name):
            import_log(path)


def test_each_format_is_told_by_its_first_bytes(tmp_path):
    table = write(tmp_path / "table.csv", flight(end=1.5))
    files = {
        "px4": made.write_ulog(tmp_path / "log.ulg", span=(0, 2)),
        "betaflight": made.write_blackbox(tmp_path / "log.csv", span=(0, 2)),
        "crazyflie": made.write_usd(tmp_path / "log00", span=(0, 2)),
        "mcap": made.write_mcap(tmp_path / "log.mcap", span=(0, 2)),
        "table": table,
    }
    for name, path in files.items():  # by what is in it, whatever it is called
        assert detect(path.rename(tmp_path / "renamed"), ImportOptions()) == name
    assert files.keys() == set(FORMATS)

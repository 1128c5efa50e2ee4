"""What a file begins with."""

import pytest

from eval.logs.columns import FlightLogError
from eval.logs.files import first_line, read_head


def test_a_head_is_the_first_bytes_only(tmp_path):
    path = tmp_path / "log"
    path.write_bytes(b"time,x\n" + bytes(20000))
    head = read_head(path)
    assert head == path.read_bytes()[: len(head)] and 1000 < len(head) < 20000
    assert first_line(head) == b"time,x"
    assert first_line(b"no end") == b"no end"


def test_no_file_and_an_empty_one_are_refused_by_name(tmp_path):
    with pytest.raises(FlightLogError, match=r"none\.ulg: .*cannot be read: No such file"):
        read_head(tmp_path / "none.ulg")
    (tmp_path / "empty.ulg").touch()
    with pytest.raises(FlightLogError, match=r"empty\.ulg: .*the file is empty"):
        read_head(tmp_path / "empty.ulg")

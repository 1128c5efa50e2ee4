"""The Python interface: its calls keep inputs, refuse what commands refuse, and warn as they do."""

import shutil
from functools import partial
from pathlib import Path

import pytest

import suite
from suite.diagnose import example

EXAMPLE = Path(example.__file__).parent
"""Folder of the example's flights and its vehicle file."""


@pytest.fixture
def identify(tmp_path):
    """Return a call that identifies a copy of the example's vehicle from copies of its flights."""
    for path in (*EXAMPLE.glob("*.parquet"), EXAMPLE / "vehicle.toml"):
        shutil.copy(path, tmp_path)
    flights = sorted(tmp_path.glob("*.parquet"))
    return partial(suite.identify_vehicle, flights, tmp_path / "vehicle.toml")


@pytest.mark.parametrize(
    ("out", "said"),
    [
        ("vehicle.toml", "vehicle.toml is also an input and would be overwritten"),
        ("flight_1.parquet", "its ending must be .toml$"),
    ],
)
def test_an_identification_overwrites_neither_its_vehicle_nor_a_log(identify, tmp_path, out, said):
    before = (tmp_path / out).read_bytes()
    with pytest.raises(ValueError, match=said):
        identify(tmp_path / out)
    assert (tmp_path / out).read_bytes() == before


def test_an_identified_file_says_from_how_many_flights_it_is(identify, tmp_path):
    identify(tmp_path / "mine.toml", progress=False)
    assert "by suite identify, 3 flights (rates)" in (tmp_path / "mine.toml").read_text()

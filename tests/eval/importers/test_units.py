"""Every unit that an importer takes, against what one of it is."""

import numpy as np
import pytest

from eval.importers.checks.units import ANGLES, TIMES
from eval.importers.formats import betaflight
from eval.importers.mapping_file import UNITS

TURN, G = 6.283185307179586, 9.81
ONE = {
    "s": 1.0, "ms": 0.001, "us": 0.000001, "ns": 0.000000001,
    "m": 1.0, "cm": 0.01, "mm": 0.001, "m/s": 1.0, "cm/s": 0.01, "mm/s": 0.001,
    "rad": 1.0, "deg": TURN / 360, "rad/s": 1.0, "deg/s": TURN / 360, "mrad/s": 0.001,
    "m/s^2": 1.0, "m/s2": 1.0, "g": G, "rpm": TURN / 60, "Hz": TURN,
    "1": 1.0, "%": 0.01, "65535": 1 / 65535, "N": 1.0, "N m": 1.0, "V": 1.0, "mV": 0.001,
}  # fmt: skip
"""One of each unit in SI; `65535` is the full scale of a motor command."""


def test_every_unit_of_a_mapping_is_what_it_says():
    for signal, units in UNITS.items():
        assert units == pytest.approx({name: ONE[name] for name in units}, rel=1e-12), signal


def test_every_unit_that_a_check_tries_is_what_it_says():
    assert TIMES == pytest.approx({name: ONE[name] for name in TIMES}, rel=1e-12)
    assert ANGLES == pytest.approx({"rad": 1.0, "deg": ONE["deg"], "tenths": 0.1}, rel=1e-12)


@pytest.mark.parametrize(
    ("table", "raw"),
    [
        (betaflight._TIME, 1e-6), (betaflight._ROTATION, TURN / 360),
        (betaflight._ACCELERATION, G / 2048), (betaflight._VOLT, 0.01),
    ],
)  # fmt: skip
def test_every_unit_of_betaflight_is_what_it_says(table, raw):
    """Where the header says no unit it is `raw`."""
    assert table == pytest.approx({"": raw, **{n: ONE[n] for n in table if n}}, rel=1e-12)


def test_a_column_is_in_the_unit_of_its_header(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("loopIteration,time (us),vbatLatest (mV)\n0,0,16100\n1,500,16000\n")
    box = betaflight.Blackbox(path)
    np.testing.assert_allclose(box.values(["vbatLatest"], betaflight._VOLT)[:, 0], [16.1, 16.0])
    np.testing.assert_allclose(box.values(["time"], betaflight._TIME)[:, 0], [0.0, 5e-4])

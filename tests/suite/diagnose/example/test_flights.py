"""The shipped example: its files are what the script makes, and do not name the hidden effect."""

import json

import numpy as np

from eval.logs.flight_log import read_flight
from eval.quadrotor.vehicle_file import load_vehicle
from suite.diagnose.example.flights import BITS, FOLDER, HIDDEN, VEHICLE, make_flights

FILES = sorted(FOLDER.glob("*.parquet"))


def test_the_files_are_what_the_script_makes():
    made = make_flights()
    assert [path.stem for path in FILES] == [log.name for log in made]
    for path, log in zip(FILES, made, strict=True):
        kept = read_flight(path)
        assert (kept.integrator, kept.step_s) == (log.integrator, log.step_s) == ("euler", 0.002)
        for name, bits in BITS.items():
            # Another machine's rounding may fall to the other side of a step.
            np.testing.assert_allclose(
                getattr(kept, name), getattr(log, name), rtol=0, atol=1.01 * 2.0**-bits
            )
    assert sum(path.stat().st_size for path in FILES) < 400_000


def test_nothing_in_the_files_tells_what_is_hidden():
    vehicle = load_vehicle(str(VEHICLE))
    assert not set(HIDDEN) & set(vehicle.effects)
    for path in FILES:
        text = json.dumps(read_flight(path).about)
        assert "com_offset" not in text and "battery" not in text

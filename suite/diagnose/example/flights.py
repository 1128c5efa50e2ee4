"""Simulates the example's flights in MuJoCo, and logs them with noise.

The vehicle that flies has an effect that the example's vehicle file lacks, for `suite diagnose` to
find. `python -m suite.diagnose.example.flights` writes the log files next to this file again.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from eval.effects.body import ComOffset
from eval.flights.simulate import Sensors, fly, log_of
from eval.flights.trajectory import Trajectory
from eval.logs.flight_log import FlightLog, write_flight
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import with_effects

FOLDER = Path(__file__).parent
VEHICLE = FOLDER / "vehicle.toml"
HIDDEN = {"com_offset": ComOffset((0.006, -0.0015, 0.0))}
"""The hidden effect: the centre of mass is 6 mm too far ahead and 1.5 mm too far right [m]."""
WAYS = (
    Trajectory("figure_eight", speed=5.0, size=4.0, turn="wobble"),
    Trajectory("speed_range", speed=7.0, size=6.0, height=2.0, turn="sweep"),
    Trajectory("climb", speed=3.0, size=2.0, direction=1.0),
)
"""Trajectories of the three flights."""
SENSORS = Sensors("example", 100.0, pos=0.002, attitude=0.003, gyro=0.02, acc=0.3, lost=0.005)
"""Rate of the logs [Hz], and noise of motion capture, gyro and accelerometer."""
SEED = 20
BITS = {"pos_w": 14, "quat_wxyz": 14, "rate_b": 12, "acc_b": 9, "thrust_cmd": 12, "rate_cmd_b": 12}
"""Values are rounded to 2^-n of their unit, far below the noise, so that files are small."""
NOTES = "made by suite/diagnose/example/flights.py; something is hidden in them"


def make_flights() -> list[FlightLog]:
    """Return the example's flights; they are equal on all machines except for rounding errors."""
    nominal = load_vehicle(str(VEHICLE))
    truth = with_effects(nominal, HIDDEN)
    rng = np.random.default_rng(SEED)
    logs = []
    for number, flown in enumerate(fly(nominal, truth, WAYS), start=1):
        log = log_of(flown, truth, SENSORS, rng, f"flight_{number}")
        rounded: dict[str, Any] = {}
        for name, bits in BITS.items():
            rounded[name] = np.round(getattr(log, name) * 2.0**bits) / 2.0**bits
        metadata = {"vehicle": nominal.name, "source": "simulated", "notes": NOTES, "seed": SEED}
        logs.append(replace(log, **rounded, about={**log.about, **metadata}))
    return logs


def main() -> None:
    """Write the flights next to this file."""
    for log in make_flights():
        print(write_flight(FOLDER / f"{log.name}.parquet", log))


if __name__ == "__main__":
    main()

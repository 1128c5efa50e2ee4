"""Make the example flights of `examples/flights`: a quadrotor whose battery was moved.

PYTHONPATH=. python tools/example_flights.py

Three flights of 8 s in MuJoCo by the reference quadrotor, its centre of mass 4 mm ahead and 1.5 mm
to the right of where the vehicle file has it, logged by noisy sensors.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from eval.effects import EFFECTS
from eval.flight_log import write_flight
from eval.vehicle_file import load_vehicle, save_vehicle
from suite.blind.hidden import with_effects
from suite.blind.sensors import SENSORS, log_of
from suite.plans.simulate import fly
from suite.plans.trajectory import ordinary_flights

FOLDER = Path(__file__).resolve().parents[1] / "examples" / "flights"
OFFSET_M = (0.004, -0.0015, 0.0)
SEED = 2026


def main() -> None:
    """Fly and write the logs and the vehicle file."""
    given = load_vehicle("reference")
    truth = with_effects(given, {"com_offset": EFFECTS["com_offset"].values(OFFSET_M)})
    sensors, rng = SENSORS["estimator"], np.random.default_rng(SEED)
    ways = ordinary_flights(rng, duration_s=8.0)[:3]
    FOLDER.mkdir(parents=True, exist_ok=True)
    save_vehicle(given, FOLDER / "vehicle.toml", "what the simulation believes of the quadrotor")
    for number, flight in enumerate(fly(given, truth, ways, sensors.rate_hz, rng=rng), start=1):
        name = f"flight_{number}"
        write_flight(FOLDER / f"{name}.parquet", log_of(flight, truth, sensors, rng, name))


if __name__ == "__main__":
    main()

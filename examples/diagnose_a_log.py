"""Diagnose which physical effects a simulation lacks, from three flight logs of the suite.

They are simulated flights with a displaced battery, so the centre of mass is off. Run: python
examples/diagnose_a_log.py [FOLDER]; it writes report.html, diagnosis.json and vehicle.toml. For
your own flights, `suite import` converts logs of PX4, Betaflight, Crazyflie, MCAP and CSV files.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from suite import diagnose_flights, read_flight
from suite.cli import main as suite


def main(folder: Path) -> None:
    """Diagnose the example's flights into `folder`."""
    logs = folder / "logs"
    suite(["example", "--out", str(logs)])
    flight = read_flight(logs / "flight_1.parquet")
    print(f"flight 1: {len(flight.time_s)} rows over {flight.time_s[-1] - flight.time_s[0]:.1f} s")

    diagnosis = diagnose_flights([logs], logs / "vehicle.toml", folder)
    print(f"verdict: {diagnosis['verdict']}")
    for effect in diagnosis["effects"]:
        for name, entry in effect["parameters"].items():
            print(f"{effect['name']}.{name}: {entry['value']}, 95 %: {entry['ci95']}")
    print(f"report: {folder / 'report.html'}")
    print(f"vehicle file with the effect: {folder / 'vehicle.toml'}")


if __name__ == "__main__":
    arguments = sys.argv[1:]
    main(Path(arguments[0]) if arguments else Path(tempfile.mkdtemp()))

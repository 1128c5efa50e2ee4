"""Flights that would tell apart what the data could not: written, and flown in simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from eval.logs.flight_log import write_flight
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.windows import SLICES
from suite.diagnose.plans.files import NAME, SCHEMA, remove_plan, write_plan
from suite.diagnose.plans.follow import FlightFailed
from suite.diagnose.plans.sensors import Sensors, log_of
from suite.diagnose.plans.separating import plan_for, separations_of
from suite.diagnose.plans.simulate import fly
from suite.diagnose.plans.trajectory import Trajectory
from tracks.common.files import write_json
from tracks.common.provenance import stamp

RATE_HZ = 100.0
"""Of simulated logs, or the nearest rate below that divides the rate loop's."""
TURNED = 2.1
"""By which the second flight of each trajectory is turned about z [rad]: one of the two may be
held out, and both look elsewhere."""
FLIGHTS = "flights"
"""Folder of the simulated logs, within the plan's."""


def sets_of(found: Mapping[str, Any]) -> list[set[str]]:
    """Return the sets of names that a diagnosis (its JSON) could not tell apart."""
    return [
        {effect["name"], *effect["alternatives"]}
        for effect in found["effects"]
        if effect["alternatives"]
    ]


def ways_for(found: Mapping[str, Any]) -> tuple[list[Trajectory], list[str]]:
    """Return the flights that split what `found` could not tell apart, and what to do in words."""
    ways: list[Trajectory] = []
    words: list[str] = []
    for names in sets_of(found):
        entries = separations_of(names)
        ways += plan_for(names)
        together = " from ".join(sorted(names))
        if not entries:
            words.append(f"To tell {together}: fly fast, with changes of thrust and heading.")
        for entry in entries:
            words.append(f"To tell {' from '.join(entry.pair)}: {entry.words}.")
            words += [_besides(what) for what in entry.measure]
    ways = list(dict.fromkeys(ways))
    twice = [turned for way in ways for turned in (way, replace(way, direction=TURNED))]
    return twice, list(dict.fromkeys(words))


def write_plan_of(found: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Write the plan that follows from `found`; return it, with no flights where none is needed.

    An earlier plan in `folder` goes, with its simulated logs, so that nobody takes them for these.
    """
    remove_plan(folder)
    ways, words = ways_for(found)
    if not ways:
        return {"flights": [], "words": ["Nothing is left to tell apart: no flight is planned."]}
    return write_plan(folder, ways, words)


def fly_plan(
    plan: dict[str, Any],
    sigma: np.ndarray,
    nominal: Vehicle,
    truth: Vehicle,
    folder: Path,
    seed: int,
) -> dict[str, Any]:
    """Fly `plan` in MuJoCo, write logs as noisy as those that were diagnosed, and return the plan.

    Args:
        plan: from `write_plan_of`.
        sigma: (19,) noise of each channel in its unit that the logs get; NaN: not logged.
        nominal: what the pilot believes.
        truth: what is flown.
        folder: of the plan.
        seed: of the noise and of random wind.

    Returns:
        The plan, each flight with its log's name in `flown`; `warnings` names those that failed.
    """
    rate_hz = _rate(truth)
    sensors = _sensors(sigma, rate_hz, plan["words"])
    flights, warnings = [], []
    for number, flight in enumerate(plan["flights"], 1):
        way = Trajectory(**flight["trajectory"])
        rng = np.random.default_rng([seed, number])
        try:
            (recording,) = fly(
                nominal, truth, [way], rate_hz, rng=rng, has_voltage=bool(sensors.voltage)
            )
        except FlightFailed as error:
            warnings.append(f"plan: {flight['file']} could not be flown: {error}")
            flights.append(flight)
            continue
        name = f"{FLIGHTS}/plan_{number}_{way.kind}.parquet"
        log = log_of(recording, truth, sensors, rng, name)
        told = {"source": "suite diagnose --fly", "vehicle": truth.name, "seed": seed}
        (folder / FLIGHTS).mkdir(parents=True, exist_ok=True)
        write_flight(folder / name, replace(log, about={**log.about, **told}))
        flights.append({**flight, "flown": name})
    plan = {**plan, "flights": flights}
    if flights:
        write_json(folder / NAME, {**plan, **stamp(SCHEMA, seed)})
    return {**plan, "warnings": warnings}


def _besides(what: str) -> str:
    said = {
        "motor": "Log the rotor speeds as well.",
        "voltage": "Log the battery's voltage as well.",
        "scale": "Better still: weigh the vehicle.",
    }
    return said[what]


def _rate(vehicle: Vehicle) -> float:
    frequency = vehicle.controller.frequency
    return frequency / max(1, round(frequency / RATE_HZ))


def _sensors(sigma: np.ndarray, rate_hz: float, words: list[str]) -> Sensors:
    """Return sensors as noisy as the diagnosed logs; rotor speeds and voltage where asked for."""

    def noise(group: str) -> float:
        values = sigma[SLICES[group]]
        return float(np.sqrt(np.mean(values**2))) if np.isfinite(values).all() else 0.0

    asked = " ".join(words)
    return Sensors(
        "as diagnosed",
        rate_hz,
        pos=noise("position"),
        attitude=noise("attitude"),
        gyro=noise("rates"),
        vel=noise("velocity"),
        acc=noise("accelerometer"),
        rotor=noise("rotor speed") or (5.0 if "rotor speeds" in asked else 0.0),
        voltage=0.02 if "voltage" in asked else 0.0,
    )

"""The just detectable strength of each effect, from flights without noise.

It depends only on the flights, not on a diagnosis. A direction in an effect's parameters is just
detectable if the expected log-likelihood ratio against the given vehicle is
`information.THRESHOLD`. `suite blind strengths` writes the committed table; an effect that is not
in it is computed when it is needed.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from eval.effects import EFFECTS, nameable_effects
from eval.flights.simulate import SENSORS, fly, log_of
from eval.flights.trajectory import long_flights, ordinary_flights
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle
from suite.blind.oracle.information import (
    THRESHOLD,
    Column,
    detectable,
    gust_strength,
    information,
)
from suite.common.console import Console
from tracks.common.files import write_json
from tracks.common.provenance import stamp

SCHEMA = 1
TABLE = Path(__file__).parent / "strengths.json"
VEHICLES = Path(__file__).parents[1] / "vehicles"
FLIGHTS_SEED = 7_000_000
"""Seed of the table's flights; no case uses it."""


def given_vehicle(name: str) -> Vehicle:
    """Return a nominal vehicle of the cases: `bare` or `dragged`."""
    return load_vehicle(VEHICLES / f"{name}.toml")


def vehicle_names() -> list[str]:
    """Return the vehicles of the cases."""
    return sorted(path.stem for path in VEHICLES.glob("*.toml"))


def write_table(console: Console) -> Path:
    """Write the table, `strengths` of every effect by vehicle and sensors, and return its path."""
    places = list(product(vehicle_names(), SENSORS))
    entries: dict[str, Any] = {name: {} for name in vehicle_names()}
    with console.progress("strengths", len(places)) as update:
        for done, (name, sensors) in enumerate(places, 1):
            entries[name][sensors] = strengths(name, sensors, nameable_effects())
            update(done, f"{name}, {sensors}")
    found = {**stamp(SCHEMA, FLIGHTS_SEED), "threshold": THRESHOLD, "vehicles": entries}
    write_json(TABLE, found)
    _entry.cache_clear()
    return TABLE


def strengths(vehicle: str, sensors: str, names: Sequence[str]) -> dict[str, Any]:
    """Return the table's entries of the effects `names`, computed on flights of the vehicle."""
    given, found, about = given_vehicle(vehicle), {}, SENSORS[sensors]
    rng = np.random.default_rng(FLIGHTS_SEED)
    ways = ordinary_flights(rng), long_flights(rng)
    for slow in (False, True):
        wanted = [n for n in names if EFFECTS[n].slow == slow and not EFFECTS[n].random]
        if wanted:
            flights = fly(given, given, ways[slow], about.rate_hz)
            logs = [log_of(flight, given, about, None) for flight in flights]
            info = information(given, logs, about, wanted)
            for name in wanted:
                columns = [list(info.columns[row][1:]) for row in info.rows_of(name)]
                found[name] = {"columns": columns, "matrix": info.block(name).tolist()}
    for name in (n for n in names if EFFECTS[n].random):
        size = gust_strength(given, ways[0], about, name, np.random.default_rng(FLIGHTS_SEED))
        found[name] = {"columns": [[EFFECTS[name].parameters[0].name, 0]], "detectable": size}
    return found


def columns_in_table(vehicle: str, sensors: str, effect: str) -> list[Column]:
    """Return the columns of `effect` that define its strength."""
    return [Column(effect, str(p), int(c)) for p, c in _entry(vehicle, sensors, effect)["columns"]]


def detectable_along(vehicle: str, sensors: str, effect: str, direction: np.ndarray) -> float:
    """Return the multiple of `direction` (table's columns) that is detectable, or inf."""
    entry = _entry(vehicle, sensors, effect)
    if "matrix" in entry:
        return detectable(np.array(entry["matrix"]), direction)
    alone = entry["detectable"]
    return float("inf") if alone is None else alone / float(abs(direction[0]))


@cache
def _entry(vehicle: str, sensors: str, effect: str) -> dict[str, Any]:
    stored = json.loads(TABLE.read_text(encoding="utf-8"))["vehicles"][vehicle][sensors].get(effect)
    return strengths(vehicle, sensors, [effect])[effect] if stored is None else stored

"""The just detectable strength of each effect, computed from flights without noise.

A change of the parameters of an effect is just detectable if the expected log-likelihood ratio
against the nominal vehicle is `information.THRESHOLD`. The table of strengths is a file of the
suite, which `suite blind strengths` writes. The strength of an effect that is not in the table,
such as one of a plugin, is computed when it is needed.
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
from suite.blind.oracle.information import THRESHOLD, Column, detectable, gust_strength, information
from suite.common.console import Console
from tracks.common.files import write_json
from tracks.common.provenance import stamp

SCHEMA = 1
"""Version of the table."""
TABLE = Path(__file__).parent / "strengths.json"
"""File of the table of strengths."""
VEHICLES = Path(__file__).parents[1] / "vehicles"
"""Folder of the nominal vehicles of the cases."""
FLIGHTS_SEED = 7_000_000
"""Seed of the flights from which the table is computed; no case uses it."""


def nominal_vehicle(name: str) -> Vehicle:
    """Return a nominal vehicle of the cases by its name, `bare` or `dragged`."""
    return load_vehicle(VEHICLES / f"{name}.toml")


def vehicle_names() -> list[str]:
    """Return the names of the nominal vehicles."""
    return sorted(path.stem for path in VEHICLES.glob("*.toml"))


def write_table(console: Console) -> Path:
    """Write the table of strengths, and return its path.

    It has the entries of every effect, for every nominal vehicle and set of sensors.
    """
    settings = list(product(vehicle_names(), SENSORS))
    entries: dict[str, Any] = {name: {} for name in vehicle_names()}
    with console.progress("strengths", len(settings)) as update:
        for done, (name, sensors) in enumerate(settings, 1):
            entries[name][sensors] = strengths(name, sensors, nameable_effects())
            update(done, f"{name}, {sensors}")
    table = {**stamp(SCHEMA, FLIGHTS_SEED), "threshold": THRESHOLD, "vehicles": entries}
    write_json(TABLE, table)
    _entry.cache_clear()
    return TABLE


def strengths(vehicle: str, sensors: str, names: Sequence[str]) -> dict[str, Any]:
    """Compute the entries of the effects `names` in the table.

    An entry has `columns` (names and indices of the parameter components), and `matrix`, the
    information about them. A random effect has `detectable` instead of `matrix`, the just
    detectable size of its first parameter. `sensors` names the logged channels and their noise, a
    key of `SENSORS`.
    """
    nominal, entries, channels = nominal_vehicle(vehicle), {}, SENSORS[sensors]
    rng = np.random.default_rng(FLIGHTS_SEED)
    # Slow effects, such as an empty battery, need long flights.
    ordinary, long = ordinary_flights(rng), long_flights(rng)
    for slow, trajectories in ((False, ordinary), (True, long)):
        steady = [n for n in names if EFFECTS[n].slow == slow and not EFFECTS[n].random]
        if steady:
            flights = fly(nominal, nominal, trajectories, channels.rate_hz)
            logs = [log_of(flight, nominal, channels, None) for flight in flights]
            info = information(nominal, logs, channels, steady)
            for name in steady:
                columns = [list(info.columns[row][1:]) for row in info.rows_of(name)]
                entries[name] = {"columns": columns, "matrix": info.block(name).tolist()}
    for name in (n for n in names if EFFECTS[n].random):
        size = gust_strength(nominal, ordinary, channels, name, np.random.default_rng(FLIGHTS_SEED))
        entries[name] = {"columns": [[EFFECTS[name].parameters[0].name, 0]], "detectable": size}
    return entries


def columns_in_table(vehicle: str, sensors: str, effect: str) -> list[Column]:
    """Return the parameter components of `effect` in the table, which define its strength."""
    return [Column(effect, str(p), int(c)) for p, c in _entry(vehicle, sensors, effect)["columns"]]


def detectable_along(vehicle: str, sensors: str, effect: str, direction: np.ndarray) -> float:
    """Return the multiple of a direction that is just detectable; infinite if none is.

    The direction (P,) is a change of each of `columns_in_table`; `sensors` is a key of `SENSORS`.
    """
    entry = _entry(vehicle, sensors, effect)
    if "matrix" in entry:
        return detectable(np.array(entry["matrix"]), direction)
    size = entry["detectable"]
    return float("inf") if size is None else size / float(abs(direction[0]))


@cache
def _entry(vehicle: str, sensors: str, effect: str) -> dict[str, Any]:
    """Return the entry of an effect in the table; it is computed if the table lacks it."""
    stored = json.loads(TABLE.read_text(encoding="utf-8"))["vehicles"][vehicle][sensors].get(effect)
    return strengths(vehicle, sensors, [effect])[effect] if stored is None else stored

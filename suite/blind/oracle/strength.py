"""How strong each effect must be to be detected at all: worked out without noise, and kept.

It comes from noise-free flights of the given vehicles and says nothing of any diagnosis. A
direction in an effect's parameters is just detectable where the expected log-likelihood ratio of
its flights against the given vehicle is `information.THRESHOLD`. The committed table keeps what
`suite blind strengths` found; an effect that is not in it is worked out when it is asked for.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from eval.effects import EFFECTS, nameable_effects
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle
from suite.blind.oracle.information import (
    THRESHOLD,
    Column,
    detectable,
    gust_strength,
    information,
)
from suite.blind.oracle.stretches import EVERY_S, Stretches, cut
from suite.diagnose.plans.simulate import SENSORS, fly
from suite.diagnose.plans.trajectory import long_flights, ordinary_flights
from tracks.common.files import write_json
from tracks.common.grid import markdown, table
from tracks.common.provenance import stamp

SCHEMA = 1
TABLE = Path(__file__).parent / "strengths.json"
VEHICLES = Path(__file__).parents[1] / "vehicles"
FLIGHTS_SEED = 7_000_000
"""Of the flights that the table is made from; no case uses it."""
LONG_STRIDE = 4
"""Of the stretches of long flights, every so many is looked at and counted as often."""


def given_vehicle(name: str) -> Vehicle:
    """Return a vehicle as cases give it to the diagnosis: `bare` or `dragged`."""
    return load_vehicle(VEHICLES / f"{name}.toml")


def vehicle_names() -> list[str]:
    """Return the vehicles of the cases."""
    return sorted(path.stem for path in VEHICLES.glob("*.toml"))


def make_table(progress: Callable[[float, str], None] | None = None) -> dict[str, Any]:
    """Return the table: `strengths` of every effect by vehicle and sensors.

    Args:
        progress: called with how many of `table_size()` parts are done and a note.
    """
    entries: dict[str, Any] = {name: {} for name in vehicle_names()}
    for done, (name, sensors) in enumerate(_places(), 1):
        entries[name][sensors] = strengths(name, sensors, nameable_effects())
        if progress is not None:
            progress(done, f"{name}, {sensors}")
    return {**stamp(SCHEMA, FLIGHTS_SEED), "threshold": THRESHOLD, "vehicles": entries}


def _places() -> list[tuple[str, str]]:
    """Return the vehicles and sensors of the table."""
    return [(name, sensors) for name in vehicle_names() for sensors in SENSORS]


def strengths(vehicle: str, sensors: str, names: Sequence[str]) -> dict[str, Any]:
    """Return the table's entries of the effects `names`, worked out on flights of the vehicle."""
    given, found = given_vehicle(vehicle), {}
    for slow in (False, True):
        wanted = [n for n in names if EFFECTS[n].slow == slow and not EFFECTS[n].random]
        if wanted:
            flown, _ = _flown(vehicle, sensors, slow)
            info = information(given, flown, SENSORS[sensors], wanted)
            weight = LONG_STRIDE if slow else 1
            for name in wanted:
                found[name] = {
                    "columns": [list(info.columns[row][1:]) for row in info.rows_of(name)],
                    "matrix": (weight * info.block(name)).tolist(),
                }
    for name in (n for n in names if EFFECTS[n].random):
        flown, rng = _flown(vehicle, sensors, False)
        size = gust_strength(given, flown, SENSORS[sensors], name, deepcopy(rng))
        found[name] = {"columns": [[EFFECTS[name].parameters[0].name, 0]], "detectable": size}
    return found


@cache
def _flown(vehicle: str, sensors: str, slow: bool) -> tuple[Stretches, np.random.Generator]:
    """Return the stretches that strengths are worked out on, and the random numbers after them."""
    given, rng = given_vehicle(vehicle), np.random.default_rng(FLIGHTS_SEED)
    ways = ordinary_flights(rng), long_flights(rng)
    flights = fly(given, given, ways[slow], SENSORS[sensors].rate_hz)
    return cut(flights, every_s=(LONG_STRIDE if slow else 1) * EVERY_S), rng


def table_size() -> int:
    """Return the number of parts of the table."""
    return len(_places())


def save_table(table: dict[str, Any], path: Path = TABLE) -> Path:
    """Write the table."""
    write_json(path, table)
    _load.cache_clear()
    _entry.cache_clear()
    return path


@cache
def _load() -> dict[str, Any]:
    if not TABLE.is_file():
        raise ValueError(f"{TABLE}: missing; make it with `suite blind strengths`")
    return json.loads(TABLE.read_text(encoding="utf-8"))


def columns_in_table(vehicle: str, sensors: str, effect: str) -> list[Column]:
    """Return the columns of `effect` in which its strength is given."""
    return [Column(effect, str(p), int(c)) for p, c in _entry(vehicle, sensors, effect)["columns"]]


def detectable_along(vehicle: str, sensors: str, effect: str, direction: np.ndarray) -> float:
    """Return how often `direction` (in the table's columns) is just detectable; inf for never."""
    entry = _entry(vehicle, sensors, effect)
    if "matrix" in entry:
        return detectable(np.array(entry["matrix"]), direction)
    alone = entry["detectable"]
    return float("inf") if alone is None else alone / float(abs(direction[0]))


def table_text() -> str:
    """Return the table (Markdown): each component alone, just detectable, in its unit."""
    found: dict[Column, dict[tuple[str, str], str]] = {}
    for name in nameable_effects():
        for where in _places():
            columns = columns_in_table(*where, name)
            for column, alone in zip(columns, np.eye(len(columns)), strict=True):
                value = detectable_along(*where, name, alone)
                found.setdefault(column, {})[where] = f"{value:.2g}" if np.isfinite(value) else "–"
    lines = [
        [c.effect, f"{c.parameter} {c.component + 1}", c.spec.unit]
        + [values.get(where, "–") for where in _places()]
        for c, values in found.items()
    ]
    heads = ["effect", "component", "unit", *(", ".join(where) for where in _places())]
    return markdown(table(heads, lines))


@cache
def _entry(vehicle: str, sensors: str, effect: str) -> dict[str, Any]:
    stored = _load()["vehicles"][vehicle][sensors].get(effect)
    return strengths(vehicle, sensors, [effect])[effect] if stored is None else stored

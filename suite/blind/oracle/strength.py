"""How strong each effect must be to be detected at all: a committed table, made without noise.

`suite blind strengths` makes it from noise-free flights of the given vehicles; it says nothing of
any diagnosis. A direction in an effect's parameters is just detectable where the expected
log-likelihood ratio of its flights against the given vehicle is `information.THRESHOLD`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle
from suite.blind.sensors import SENSORS
from tracks.common.files import write_json
from tracks.common.provenance import stamp

SCHEMA = 1
TABLE = Path(__file__).parent / "strengths.json"
VEHICLES = Path(__file__).parents[1] / "vehicles"
FLIGHTS_SEED = 7_000_000
"""Of the flights that the table is made from; no case uses it."""
GUST_LENGTH_M = 5.0
"""Of the random wind in the table and in cases."""
LONG_STRIDE = 4
"""Of the stretches of long flights, every so many is looked at and counted as often."""


def given_vehicle(name: str) -> Vehicle:
    """Return a vehicle as cases give it to the diagnosis: `bare` or `dragged`."""
    return load_vehicle(VEHICLES / f"{name}.toml")


def vehicle_names() -> list[str]:
    """Return the vehicles of the cases."""
    return sorted(path.stem for path in VEHICLES.glob("*.toml"))


def make_table(progress: Callable[[float, str], None] | None = None) -> dict[str, Any]:
    """Return the table: information matrices by vehicle, sensors and effect.

    Args:
        progress: called with how many of `table_size()` parts are done and a note.
    """
    from suite.blind.oracle.information import THRESHOLD, gust_strength, information
    from suite.blind.oracle.stretches import EVERY_S, cut
    from suite.diagnose.plans.simulate import fly
    from suite.diagnose.plans.trajectory import long_flights, ordinary_flights

    entries: dict[str, Any] = {}
    done = 0
    for name in vehicle_names():
        vehicle = given_vehicle(name)
        entries[name] = {}
        for sensors in SENSORS.values():
            rng = np.random.default_rng(FLIGHTS_SEED)
            ordinary = cut(fly(vehicle, vehicle, ordinary_flights(rng), sensors.rate_hz))
            slow = fly(vehicle, vehicle, long_flights(rng), sensors.rate_hz)
            several = cut(slow, every_s=LONG_STRIDE * EVERY_S)
            blocks: dict[str, Any] = {}
            for info, weight in (
                (information(vehicle, (), sensors, ordinary), 1),
                (information(vehicle, (), sensors, several), LONG_STRIDE),
            ):
                for effect in dict.fromkeys(column.effect for column in info.columns):
                    if (weight > 1) != (effect == "battery_sag"):
                        continue
                    rows = info.rows_of(effect)
                    blocks[effect] = {
                        "columns": [list(info.columns[row][1:]) for row in rows],
                        "matrix": (weight * info.matrix[np.ix_(rows, rows)]).tolist(),
                    }
            gusts = gust_strength(vehicle, ordinary, sensors, GUST_LENGTH_M, rng)
            blocks["gusts"] = {"columns": [["intensity", 0]], "detectable": gusts}
            entries[name][sensors.name] = blocks
            done += 1
            if progress is not None:
                progress(done, f"{name}, {sensors.name}")
    return {**stamp(SCHEMA, FLIGHTS_SEED), "threshold": THRESHOLD, "vehicles": entries}


def table_size() -> int:
    """Return the number of parts of the table."""
    return len(vehicle_names()) * len(SENSORS)


def save_table(table: dict[str, Any], path: Path = TABLE) -> Path:
    """Write the table."""
    write_json(path, table)
    _load.cache_clear()
    return path


@cache
def _load() -> dict[str, Any]:
    import json

    if not TABLE.is_file():
        raise ValueError(f"{TABLE}: missing; make it with `suite blind strengths`")
    return json.loads(TABLE.read_text(encoding="utf-8"))


def columns_in_table(vehicle: str, sensors: str, effect: str) -> list[tuple[str, int]]:
    """Return (parameter, component) of each column of `effect`."""
    return [(str(p), int(c)) for p, c in _entry(vehicle, sensors, effect)["columns"]]


def detectable_along(vehicle: str, sensors: str, effect: str, direction: np.ndarray) -> float:
    """Return how often `direction` (in the table's columns) is just detectable; inf for never."""
    from suite.blind.oracle.information import THRESHOLD

    entry = _entry(vehicle, sensors, effect)
    if effect == "gusts":
        alone = entry["detectable"]
        return float("inf") if alone is None else alone / float(abs(direction[0]))
    ratio = float(0.5 * direction @ np.array(entry["matrix"]) @ direction)
    return float(np.sqrt(THRESHOLD / ratio)) if ratio > 1e-12 else float("inf")


def table_text() -> str:
    """Return the table (Markdown): each component alone, just detectable, in its unit."""
    from eval.effects import EFFECTS

    vehicles = [(v, s) for v in vehicle_names() for s in SENSORS]
    lines = [
        "| effect | component | unit | " + " | ".join(f"{v}, {s}" for v, s in vehicles) + " |",
        "|---|---|---|" + "---|" * len(vehicles),
    ]
    for name, effect in EFFECTS.items():
        units = {parameter.name: parameter.unit for parameter in effect.parameters}
        found: dict[tuple[str, int], dict[tuple[str, str], float]] = {}
        for where in vehicles:
            columns = columns_in_table(*where, name)
            for index, column in enumerate(columns):
                alone = np.eye(len(columns))[index]
                found.setdefault(column, {})[where] = detectable_along(*where, name, alone)
        for (parameter, component), values in found.items():
            cells = [_cell(values.get(where)) for where in vehicles]
            text = f"{parameter} {component + 1}"
            lines.append(f"| {name} | {text} | {units[parameter]} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _cell(value: float | None) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.2g}"


def _entry(vehicle: str, sensors: str, effect: str) -> dict[str, Any]:
    return _load()["vehicles"][vehicle][sensors][effect]

"""Flights of the judge without a pose: which effects are named by gyro, accelerometer and motors?

    python tools/poseless.py runs/poseless [CASES [SEED [FIRST]]]

Every case hides one effect of usual size, or none, in a vehicle that flies six tracks. Its logs
hold gyro, accelerometer, set points, rotor speeds and voltage alone, with noise and constant biases
as a small board's sensors have them. Prints a line a case; then how many are named alone, how many
good ones are accused, and how many 95 % intervals hold the truth.
"""

from __future__ import annotations

import contextlib
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from eval.effects.interface import at
from eval.logs.flight_log import FlightLog, read_flight
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from eval.vehicles.vehicle import Vehicle, with_effects
from suite.common.console import Console
from suite.common.startup import keep_compiled
from suite.diagnose.diagnose import diagnose
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.experiments.injected.flights import as_log, flight_parts
from suite.judging.collect import collect
from suite.judging.requests import Collection

NOMINAL = "reference"
SEEN = (
    *("thrust_scale", "weak_motor", "linear_drag", "rotor_drag", "quadratic_drag", "thrust_tilt"),
    *("com_offset", "torque_trim", "inertia_scale", "inflow"),
)
"""Effects that rates or the specific force show on such flights."""
GOOD_EACH = 5
"""Every so many cases hide nothing."""
GYRO_BIAS, ACC_BIAS = 0.005, 0.05
"""Standard deviation of each axis's constant error in a flight [rad/s], [m/s^2]."""
KEPT = ("time", "rate", "acc", "cmd_thrust", "cmd_rate", "motor", "voltage")


def hidden_values(name: str, vehicle: Vehicle, rng: np.random.Generator) -> Any:
    """Return an effect's values, each as far as is usual from what the vehicle file has."""
    effect, values = EFFECTS[name], []
    for k, p in enumerate(effect.parameters):
        away = np.full(p.size or 1, rng.uniform(*p.typical) * rng.choice(p.signs))
        if p.direction:
            away *= np.asarray(p.direction)
        if p.one_at_a_time:
            away = np.roll(away, rng.integers(len(away)))
        known = vehicle.effects.get(name)
        each = (at(p.neutral, vehicle) if known is None else np.asarray(known[k])) + away
        values.append(tuple(map(float, each)) if p.size else float(each[0]))
    return effect.values(*values)


def without_pose(log: FlightLog, vehicle: Vehicle, rng: np.random.Generator) -> FlightLog:
    """Return what a board without a position logs of a flight."""
    parts = flight_parts(log, vehicle, rng)
    parts["rate"] = parts["rate"] + GYRO_BIAS * rng.normal(size=3)
    parts["acc"] = parts["acc"] + ACC_BIAS * rng.normal(size=3)
    return as_log({name: parts[name] for name in KEPT}, log.name)


def run(out: Path, cases: int, seed: int, first: int = 0) -> Iterator[dict[str, Any]]:
    """Yield what was hidden and what was found, case by case."""
    nominal, console = load_vehicle(NOMINAL), Console()
    for number in range(first, cases):
        rng = np.random.default_rng([seed, number])
        name = "" if number % GOOD_EACH == 0 else SEEN[number % len(SEEN)]
        name = SEEN[int(rng.integers(len(SEEN)))] if name else ""
        hidden = {name: hidden_values(name, nominal, rng)} if name else {}
        folder = out / f"case_{number:03d}"
        folder.mkdir(parents=True, exist_ok=True)
        true = with_effects(nominal, hidden)
        save_vehicle(true, folder / "true.toml", name or "nothing")
        flights = Collection(difficulty="0,3", trials=1, vehicle=str(folder / "true.toml"),
                           seed=seed + 1000 * number)  # fmt: skip
        if not (folder / "flights" / "flights.json").exists():
            collect(flights, folder / "flights", console, None)
        files = sorted((folder / "flights").glob("*.parquet"))
        logs = [without_pose(read_flight(f), nominal, rng) for f in files]
        logs = [log for log in logs if log.duration_s > 3.0]
        found = diagnosis_json(diagnose(logs, nominal, by="views", seed=number))
        yield {"case": number, "hidden": name, "truth": hidden.get(name), "flights": len(logs),
               "found": found}  # fmt: skip


def covered(truth: Any, effect: dict[str, Any]) -> Iterator[bool]:
    """Yield for every number of a named effect whether its interval holds the truth."""
    parameters = effect["parameters"]
    rotor = parameters.get("index", {}).get("value")
    for key, entry in parameters.items():
        if key == "index" or entry["ci95"] is None:
            continue
        true = np.atleast_1d(getattr(truth, key))
        true = true[[int(rotor) - 1]] if rotor is not None else true
        pairs = entry["ci95"] if isinstance(entry["value"], list) else [entry["ci95"]]
        for value, pair in zip(true, pairs, strict=False):
            if pair is not None and None not in pair and pair[1] > pair[0]:
                yield bool(pair[0] <= value <= pair[1])


def main() -> None:
    """Run the cases and print their table."""
    out, *rest = sys.argv[1:]
    cases, seed, first = (int(v) for v in (*rest, *("60", "560000", "0")[len(rest) :]))
    keep_compiled()
    outcomes, held = Counter[str](), []
    for one in run(Path(out), cases, seed, first):
        effects, name = one["found"]["effects"], one["hidden"]
        alike = [{e["name"], *e["alternatives"]} for e in effects]
        if not name:
            outcome = "accused" if effects else "clean"
        elif len(effects) == 1 and name in alike[0]:
            outcome = "named alone"
            if effects[0]["name"] == name:
                held += list(covered(one["truth"], effects[0]))
        elif any(name in group for group in alike):
            outcome = "named with another"
        else:
            outcome = "another name" if effects else "not named"
        outcomes[outcome] += 1
        words = [" or ".join([e["name"], *e["alternatives"]]) for e in effects]
        line = f"{one['case']:3d} {name or 'nothing':16} {outcome:18} {'; '.join(words)}"
        print(line, flush=True)
    print(", ".join(f"{name}: {count}" for name, count in outcomes.items()))
    print(f"intervals that hold the truth: {sum(held)} of {len(held)}")


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()

"""Flights without a pose: which effects are named by gyro, accelerometer and motors?

    python tools/poseless.py [CASES [SEED [FIRST]]]

Every case hides one effect of usual size, or none, in a vehicle that flies six trajectories in
MuJoCo, 8 s each. Its logs hold gyro, accelerometer, set points, rotor speeds and voltage alone,
with noise and constant biases as a small board's sensors have them. Prints a line a case, with the
errors of the named numbers over half their intervals; then how many effects are named alone, how
many clean vehicles get a name (false alarms), and how many 95 % intervals hold the truth, each with
its 95 % interval (Clopper and Pearson). 60 cases take about 6 minutes on two cores.
"""

from __future__ import annotations

import contextlib
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import binomtest

from eval.effects import EFFECTS
from eval.effects.interface import bound_value
from eval.flights.follow import FlightFailed
from eval.flights.simulate import Sensors, fly, log_of
from eval.flights.trajectory import ordinary_flights
from eval.logs.flight_log import FlightLog
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle, with_effects
from suite.common.startup import keep_compiled
from suite.diagnose.diagnose import diagnose
from suite.diagnose.report.diagnosis_json import diagnosis_json

NOMINAL = "reference"
SEEN = (
    *("thrust_scale", "weak_motor", "linear_drag", "rotor_drag", "quadratic_drag", "thrust_tilt"),
    *("com_offset", "torque_trim", "inertia_scale", "inflow"),
)
"""Effects that rates or the specific force show on such flights."""
CLEAN_EACH = 4
"""Every so many cases hide nothing."""
BOARD = Sensors("board", 100.0, pos=0.0, attitude=0.0, gyro=0.03, acc=0.3, rotor=3.0, voltage=0.05)
GYRO_BIAS, ACC_BIAS = 0.005, 0.05
"""Standard deviation of each axis's constant error in a flight [rad/s], [m/s^2]."""
FLIGHTS, FLIGHT_S = 6, 8.0


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
        each = (bound_value(p.neutral, vehicle) if known is None else np.asarray(known[k])) + away
        values.append(tuple(map(float, each)) if p.size else float(each[0]))
    return effect.values(*values)


def flown(nominal: Vehicle, true: Vehicle, rng: np.random.Generator) -> list[FlightLog]:
    """Return what a board without a position logs of flights of the vehicle `true`."""
    while True:
        ways = [one for _ in range(2) for one in ordinary_flights(rng, FLIGHT_S)]
        ways = [one for one in ways if one.kind != "low"][:FLIGHTS]
        try:
            recordings = fly(nominal, true, ways, BOARD.rate_hz)
        except FlightFailed:  # too fast for what is hidden: others are drawn
            continue
        break
    logs = []
    for number, recording in enumerate(recordings):
        log = log_of(recording, true, BOARD, rng, f"flight {number}")
        assert log.acc_b is not None
        lost = np.full_like(log.quat_wxyz, np.nan)
        logs.append(
            replace(
                log, pos_w=lost[:, :3], vel_w=lost[:, :3], quat_wxyz=lost, velocity_derived=True,
                rate_b=log.rate_b + GYRO_BIAS * rng.normal(size=3),
                acc_b=log.acc_b + ACC_BIAS * rng.normal(size=3), about={"partial": ["pos", "quat"]},
            )
        )  # fmt: skip
    return logs


def run(cases: int, seed: int, first: int) -> Iterator[tuple[str, Any, dict[str, Any]]]:
    """Yield the name of what was hidden, its values and what was found, case by case."""
    nominal = load_vehicle(NOMINAL)
    for number in range(first, first + cases):
        rng = np.random.default_rng([seed, number])
        name = "" if number % CLEAN_EACH == 0 else SEEN[int(rng.integers(len(SEEN)))]
        truth = hidden_values(name, nominal, rng) if name else None
        true = with_effects(nominal, {name: truth} if name else {})
        found = diagnose(flown(nominal, true, rng), nominal, by="views", seed=number)
        yield name, truth, diagnosis_json(found)


def errors(truth: Any, effect: dict[str, Any]) -> Iterator[float]:
    """Yield by what the numbers of a named effect are off, over half their 95 % intervals."""
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
                yield float((sum(pair) - 2.0 * value) / (pair[1] - pair[0]))


def outcome_of(name: str, effects: list[dict[str, Any]]) -> str:
    """Return how what is named compares with what was hidden, `name`, in words."""
    alike = [{e["name"], *e["alternatives"]} for e in effects]
    if not name:
        return "false alarm" if effects else "clean"
    if len(effects) == 1 and name in alike[0]:
        return "named alone"
    if any(name in group for group in alike):
        return "named with another"
    return "another name" if effects else "not named"


def share(words: str, count: int, of: int) -> str:
    """Return a line with a share and its interval."""
    low, high = binomtest(count, of).proportion_ci() if of else (0.0, 1.0)
    return f"{words}: {count} of {of} ({100 * low:.0f} to {100 * high:.0f} %)"


def main() -> None:
    """Run the cases and print their table."""
    given = sys.argv[1:]
    cases, seed, first = (int(v) for v in (*given, *("60", "5600000", "0")[len(given) :]))
    keep_compiled()
    outcomes, off = Counter[str](), list[float]()
    for number, (name, truth, found) in enumerate(run(cases, seed, first), first):
        effects = found["effects"]
        outcome = outcome_of(name, effects)
        outcomes[outcome] += 1
        words = [" or ".join([e["name"], *e["alternatives"]]) for e in effects]
        own = [e for e in effects if e["name"] == name]
        scaled = list(errors(truth, own[0])) if own else []
        off += scaled
        print(f"{number:3d} {name or 'nothing':16} {outcome:18} {'; '.join(words)}  "
              f"{' '.join(f'{e:+.2f}' for e in scaled)}", flush=True)  # fmt: skip
    clean = outcomes["clean"] + outcomes["false alarm"]
    print(share("named, and nothing else", outcomes["named alone"], cases - clean))
    print(share("clean vehicles with a false alarm", outcomes["false alarm"], clean))
    print(share("intervals that hold the truth", sum(abs(e) <= 1.0 for e in off), len(off)))


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()

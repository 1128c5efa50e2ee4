"""Measure which effects the diagnosis names from logs without position and attitude.

    python tools/poseless.py [CASES [SEED [FIRST]]]

An effect is a physical cause of a mismatch between vehicle file and flights. Every case has one
hidden effect of usual size, or none, in a vehicle that flies six trajectories of 8 s in MuJoCo. The
logs have only gyro, accelerometer, set points, rotor speeds and voltage, with noise and constant
biases as the sensors of a small board have them.

The tool prints a line for each case, with the errors of the named parameters divided by half of
their intervals. Then it prints two shares, each with its 95 % interval (Clopper and Pearson):
cases in which the hidden effect is named and nothing else; and vehicles without an effect for which
one is named (false alarms). Last it prints how many 95 % intervals contain the true value. 60 cases
take about 6 minutes on two cores.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import tyro
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
"""Name of the vehicle file that the diagnosis gets."""
IDENTIFIABLE = (
    *("thrust_scale", "weak_motor", "linear_drag", "rotor_drag", "quadratic_drag", "thrust_tilt"),
    *("com_offset", "torque_trim", "inertia_scale", "inflow"),
)
"""The hidden effects: those that change body rates or specific force on such flights."""
CLEAN_EVERY = 4
"""Cases whose number is divisible by this have no hidden effect ("clean")."""
BOARD = Sensors("board", 100.0, pos=0.0, attitude=0.0, gyro=0.03, acc=0.3, rotor=3.0, voltage=0.05)
"""Rate and noise of the logs."""
GYRO_BIAS, ACC_BIAS = 0.005, 0.05
"""Standard deviations of the constant errors of gyro [rad/s] and accelerometer [m/s^2], drawn for
each axis and flight."""
FLIGHTS, FLIGHT_S = 6, 8.0
"""Number of flights of a case, and their duration [s]."""


def hidden_values(name: str, vehicle: Vehicle, rng: np.random.Generator) -> Any:
    """Return random values of an effect, which differ from those of `vehicle` by a usual size."""
    effect, values = EFFECTS[name], []
    for k, p in enumerate(effect.parameters):
        change = np.full(p.size or 1, rng.uniform(*p.typical) * rng.choice(p.signs))
        if p.direction:
            change *= np.asarray(p.direction)
        if p.one_at_a_time:  # one component only, such as one weak motor: a random one
            change = np.roll(change, rng.integers(len(change)))
        nominal = vehicle.effects.get(name)
        value = (
            bound_value(p.neutral, vehicle) if nominal is None else np.asarray(nominal[k])
        ) + change
        values.append(tuple(map(float, value)) if p.size else float(value[0]))
    return effect.values(*values)


def fly_logs(nominal: Vehicle, true: Vehicle, rng: np.random.Generator) -> list[FlightLog]:
    """Fly the vehicle `true`, and return logs without a pose.

    The tracking controller uses the vehicle file `nominal`.
    """
    while True:
        # Trajectories close to the ground are left out.
        trajectories = [t for _ in range(2) for t in ordinary_flights(rng, FLIGHT_S)]
        trajectories = [t for t in trajectories if t.kind != "low"][:FLIGHTS]
        try:
            recordings = fly(nominal, true, trajectories, BOARD.rate_hz)
        except FlightFailed:  # a trajectory is too fast for this effect: draw others
            continue
        break
    logs = []
    for number, recording in enumerate(recordings):
        log = log_of(recording, true, BOARD, rng, f"flight {number}")
        assert log.acc_b is not None
        nan = np.full_like(log.quat_wxyz, np.nan)
        logs.append(
            replace(
                log, pos_w=nan[:, :3], vel_w=nan[:, :3], quat_wxyz=nan, velocity_derived=True,
                rate_b=log.rate_b + GYRO_BIAS * rng.normal(size=3),
                acc_b=log.acc_b + ACC_BIAS * rng.normal(size=3), about={"partial": ["pos", "quat"]},
            )
        )  # fmt: skip
    return logs


def run(cases: int, seed: int, first: int) -> Iterator[tuple[str, Any, dict[str, Any]]]:
    """Yield the hidden effect ("" for none), its values and the diagnosis, case by case."""
    nominal = load_vehicle(NOMINAL)
    for number in range(first, first + cases):
        rng = np.random.default_rng([seed, number])
        name = (
            "" if number % CLEAN_EVERY == 0 else IDENTIFIABLE[int(rng.integers(len(IDENTIFIABLE)))]
        )
        truth = hidden_values(name, nominal, rng) if name else None
        true = with_effects(nominal, {name: truth} if name else {})
        diagnosis = diagnose(fly_logs(nominal, true, rng), nominal, by="views", seed=number)
        yield name, truth, diagnosis_json(diagnosis)


def errors(truth: Any, effect: dict[str, Any]) -> Iterator[float]:
    """Yield the error of each parameter of a named effect, divided by half of its 95 % interval.

    `truth` has the true values, `effect` is the entry of the diagnosis.
    """
    parameters = effect["parameters"]
    rotors = parameters.get("index", {}).get("value")  # a number, or a list of several
    for key, entry in parameters.items():
        if key == "index" or entry["ci95"] is None:
            continue
        true = np.atleast_1d(getattr(truth, key))
        true = true if rotors is None else true[np.atleast_1d(rotors).astype(int) - 1]
        intervals = entry["ci95"] if isinstance(entry["value"], list) else [entry["ci95"]]
        for value, interval in zip(true, intervals, strict=False):
            if interval is not None and None not in interval and interval[1] > interval[0]:
                yield float((sum(interval) - 2.0 * value) / (interval[1] - interval[0]))


def outcome_of(name: str, effects: list[dict[str, Any]]) -> str:
    """Return the outcome of a case as text; `name` is the hidden effect, "" for none."""
    name_sets = [{e["name"], *e["alternatives"]} for e in effects]
    if not name:
        return "false alarm" if effects else "clean"
    if len(effects) == 1 and name in name_sets[0]:
        return "named alone"
    if any(name in names for names in name_sets):
        return "named with another"
    return "another name" if effects else "not named"


def share_line(label: str, count: int, of: int) -> str:
    """Return a line with a share and its 95 % interval."""
    low, high = binomtest(count, of).proportion_ci() if of else (0.0, 1.0)
    return f"{label}: {count} of {of} ({100 * low:.0f} to {100 * high:.0f} %)"


def main(
    cases: tyro.conf.Positional[int] = 60,
    seed: tyro.conf.Positional[int] = 5_600_000,
    first: tyro.conf.Positional[int] = 0,
) -> None:
    """Run the cases, and print a line for each and the shares."""
    keep_compiled()
    outcomes, all_errors = Counter[str](), list[float]()
    for number, (name, truth, diagnosis) in enumerate(run(cases, seed, first), first):
        effects = diagnosis["effects"]
        outcome = outcome_of(name, effects)
        outcomes[outcome] += 1
        names = [" or ".join([e["name"], *e["alternatives"]]) for e in effects]
        right = [e for e in effects if e["name"] == name]
        case_errors = list(errors(truth, right[0])) if right else []
        all_errors += case_errors
        print(f"{number:3d} {name or 'nothing':16} {outcome:18} {'; '.join(names)}  "
              f"{' '.join(f'{e:+.2f}' for e in case_errors)}", flush=True)  # fmt: skip
    clean = outcomes["clean"] + outcomes["false alarm"]
    covered = sum(abs(e) <= 1.0 for e in all_errors)
    print(share_line("named, and nothing else", outcomes["named alone"], cases - clean))
    print(share_line("clean vehicles with a false alarm", outcomes["false alarm"], clean))
    # No interval of this share: the intervals of one diagnosis are not independent.
    print(f"intervals that contain the truth: {covered} of {len(all_errors)}")


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        tyro.cli(main)

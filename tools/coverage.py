"""Measure how often the 95 % intervals of `suite identify` contain the true value.

    python tools/coverage.py COUNT [SEED] [CASES] [OUT.json]

It estimates the parameters of COUNT simulated vehicles with random parameters (fleets of
`tests/support/fleets.py`), whose logs have a state estimator's slow errors (first-order, 0.1 to
1 s) besides noise that is white from row to row. A case says which signals the logs have; CASES are
separated by commas, and all by default. For every parameter of a vehicle file the tool prints:

- for how many vehicles it was estimated,
- for how many of these the 95 % interval contains the true value, with Wilson's interval,
- the median half-width of the interval, relative to the true value,
- mean and root mean square of the pulls. A pull is an error divided by the half-width of the
  interval. For exact intervals the mean is 0 and the root mean square 0.51.

A second table, that of docs/results/identify.md, has a row for each parameter and a column for each
case. Its entries are the number of intervals that contain the true value, of all intervals.
"""

from __future__ import annotations

import json
import sys
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np
import tyro
from scipy.signal import lfilter

from eval.effects import EFFECTS
from eval.flights.follow import FlightFailed, Recording
from eval.flights.trajectory import Trajectory
from eval.judging.statistics import wilson
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import MotorMap
from suite.diagnose.identify.drive import KNOWN_MOTORS, torque_ratios
from suite.diagnose.identify.identify import identify
from tracks.geometry.rotation import exp_rot, rot_to_quat

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for tests/support
from tests.support.fleets import DELAY, Fleet, logs_of, recordings_of, start

CASES = {
    "rotors": ("rotors", ()),
    "pwm": ("pwm", ()),
    "torques": ("torques", ()),
    "rates": ("rates", ()),
    "pwm without attitude": ("pwm", ("quat_wxyz",)),
    "pwm without rates": ("pwm", ("rate_b",)),
}
"""Case -> the logged input of the flights, and the signals that are removed from their logs."""
DRAG, FLAPPING = "linear_drag", "blade_flapping"


@dataclass(frozen=True)
class Slow:
    """A state estimator's errors: standard deviation, and how long they last [s]."""

    pos: tuple[float, float] = (0.004, 0.5)
    """Each axis [m]."""
    vel: tuple[float, float] = (0.03, 0.3)
    """Each axis [m/s]."""
    attitude: tuple[float, float] = (0.006, 1.0)
    """About each body axis [rad]."""
    gyro: tuple[float, float] = (0.02, 0.1)
    """Each axis [rad/s]."""


def drawn(rng: np.random.Generator, duration_s: float = 8.0) -> Fleet:
    """Return a fleet of drawn numbers on drawn flights: an eight, a circle, climbs, a chirp."""

    def factor(span: float, count: int) -> np.ndarray:
        return np.exp(rng.uniform(-span, span, count))

    nominal = start()
    inertia = np.asarray(nominal.inertia) * factor(0.3, 3)
    inertia = np.minimum(inertia, 0.98 * (inertia.sum() - inertia))
    k_t, k_q = factor(0.2, 1)[0], factor(0.3, 1)[0]
    rotors = replace(
        nominal.rotors,
        thrust_coefficient=float(nominal.rotors.thrust_coefficient * k_t),
        torque_coefficient=float(nominal.rotors.torque_coefficient * k_q),
        time_constant=float(rng.uniform(0.015, 0.05)),
    )
    gains = (*rng.uniform(12.0, 26.0, 2).tolist(), float(rng.uniform(5.0, 10.0)))
    motors = MotorMap(
        thrust=(float(rng.uniform(0.5, 2.5)), float(rng.uniform(2.5, 5.0))),
        voltage=16.0,
        voltage_exponent=float(rng.uniform(0.5, 1.6)),
    )
    step_s = 1.0 / nominal.controller.frequency
    effects = {
        DRAG: EFFECTS[DRAG].values(tuple(rng.uniform(0.1, 0.6, 3).tolist())),
        DELAY: EFFECTS[DELAY].values(float(step_s * rng.integers(1, 11))),
    }
    truth = replace(
        nominal,
        inertia=tuple(inertia.tolist()),
        rotors=rotors,
        controller=replace(nominal.controller, rate_gain=gains),
        motors=motors,
        effects=MappingProxyType(effects),
    )
    speeds = rng.uniform(2.5, 5.0, 4) * [1.0, 1.0, 0.8, 0.2]
    kinds = {"figure_eight": "sweep", "circle": "wobble", "climb": "wobble", "chirp": "wobble"}
    ways = tuple(
        Trajectory(kind, duration_s, speed, turn=turn, direction=float(rng.uniform(0.0, 2 * np.pi)))
        for (kind, turn), speed in zip(kinds.items(), speeds.tolist(), strict=True)
    )
    scale = float(factor(0.15, 1)[0])
    flapping = EFFECTS[FLAPPING].values(float(rng.uniform(1e-7, 6e-7)))
    blown = MappingProxyType({**effects, FLAPPING: flapping})
    return Fleet(replace(truth, effects=blown), ways, scale)


def truths(fleet: Fleet, drive: str, identified: str = "xyz") -> Mapping[str, tuple[float, ...]]:
    """Return the true values of all numbers that may be identified, by key of a vehicle file.

    Only ratios of some numbers are identifiable. So the torque coefficient is the one that belongs
    to the file's other numbers. If the inertia about z is not among the axes `identified`, it is
    scaled like those that are. The thrust coefficient is identifiable from rotor speeds only. The
    coefficient of flapping depends on the rotor speeds, and so on the thrust coefficient. A scale
    of the thrust in the file scales the torques of its rate loop too.
    """
    true, begun = fleet.truth, start()
    assert true.motors is not None
    ratio = np.asarray(true.inertia) / begun.inertia
    twist = true.rotors.torque_coefficient
    if "z" not in identified:
        twist *= float(
            np.sqrt(np.prod([ratio["xy".index(axis)] for axis in identified])) / ratio[2]
        )
    flapping = true.effects[FLAPPING].coefficient
    if drive != "rotors":
        ratio_t = begun.rotors.thrust_coefficient / true.rotors.thrust_coefficient
        twist, flapping = twist * ratio_t, flapping * ratio_t**0.5
    ratios = torque_ratios(1.0 if drive in KNOWN_MOTORS else fleet.scale)
    return {
        "motors.thrust": true.motors.thrust,
        "motors.voltage_exponent": (true.motors.voltage_exponent,),
        "effects.linear_drag.coefficient": tuple(true.effects[DRAG].coefficient),
        "effects.thrust_scale.scale": (fleet.scale,),
        "effects.blade_flapping.coefficient": (flapping,),
        "effects.command_delay.delay": (true.effects[DELAY].delay,),
        "inertia": true.inertia,
        "rotors.thrust_coefficient": (true.rotors.thrust_coefficient,),
        "rotors.torque_coefficient": (twist,),
        "rotors.time_constant": (true.rotors.time_constant,),
        "controller.rate_gain": tuple(true.controller.rate_gain / ratios),
    }


def with_slow_errors(log: FlightLog, slow: Slow, rng: np.random.Generator) -> FlightLog:
    """Return a log to which a state estimator's errors are added."""
    rot_w = log.rot_w @ np.asarray(exp_rot(_wander(log, slow.attitude, rng)))
    return replace(
        log,
        pos_w=log.pos_w + _wander(log, slow.pos, rng),
        vel_w=log.vel_w + _wander(log, slow.vel, rng),
        quat_wxyz=np.asarray(rot_to_quat(rot_w)),
        rate_b=log.rate_b + _wander(log, slow.gyro, rng),
    )


def _wander(log: FlightLog, size: tuple[float, float], rng: np.random.Generator) -> np.ndarray:
    """Return a stationary first-order process (T, 3)."""
    sigma, lasts_s = size
    keep = float(np.exp(-np.median(np.diff(log.time_s)) / lasts_s))
    push = sigma * np.sqrt(1.0 - keep**2) * rng.standard_normal((len(log.time_s), 3))
    push[0] = sigma * rng.standard_normal(3)
    return np.asarray(lfilter([1.0], [1.0, -keep], push, axis=0))


def pulls(
    fleet: Fleet, recordings: Sequence[Recording], case: str, rng: np.random.Generator
) -> dict[str, tuple[float, float]]:
    """Return name -> (pull, relative half-width) of every estimated parameter.

    The case is a key of `CASES`; `rng` draws the noise of the logs.
    """
    drive, removed = CASES[case]
    spoil = partial(with_slow_errors, slow=Slow(), rng=rng)
    logs = [
        replace(log, **{name: np.full_like(getattr(log, name), np.nan) for name in removed})
        for log in logs_of(fleet, recordings, drive, rng, spoil=spoil)
    ]
    numbers = identify(logs, start()).numbers
    intervals = {entry.key: entry.ci95 for entry in numbers}
    inertia = zip("xyz", intervals.get("inertia", ()), strict=False)
    identified_axes = "".join(axis for axis, interval in inertia if interval)
    true, results = truths(fleet, drive, identified_axes), {}
    for entry in numbers:
        for k, (value, interval) in enumerate(zip(entry.value, entry.ci95, strict=True)):
            index = f"[{k}]" if len(entry.value) > 1 else ""
            if interval is not None:
                half_width = 0.5 * (interval[1] - interval[0])
                truth = true[entry.key][k]
                pull = (value - truth) / half_width
                results[f"{entry.key}{index}"] = (pull, half_width / abs(truth))
    return results


def fly_fleet(seed: int, number: int) -> tuple[Fleet, list[Recording]] | None:
    """Return a random vehicle and its flights; None if a flight fails."""
    fleet = drawn(np.random.default_rng((seed, number)))
    try:
        return fleet, recordings_of(fleet)
    except FlightFailed:
        return None


def measure(count: int, seed: int, cases: Sequence[str], out: str) -> dict[tuple[str, str], list]:
    """Return (case, name of a parameter) -> rows, each (vehicle, pull, relative half-width).

    `count` vehicles are drawn. The rows are also written to the JSON file `out`; "" for none.
    """
    rows: dict[tuple[str, str], list] = defaultdict(list)
    start_s, number, done = time.monotonic(), 0, 0
    while done < count:
        number += 1
        fleet = fly_fleet(seed, number)
        if fleet is None:
            continue
        done += 1
        for index, case in enumerate(CASES):
            if case in cases:
                # From 1: for numpy (seed, number, 0) is (seed, number), which drew the fleet.
                rng = np.random.default_rng((seed, number, index + 1))
                for key, pull in pulls(*fleet, case, rng).items():
                    rows[case, key].append((number, *pull))
        print(f"{done}: {time.monotonic() - start_s:.0f} s", file=sys.stderr, flush=True)
        if out:
            Path(out).write_text(json.dumps({f"{c} {k}": v for (c, k), v in rows.items()}))
    return rows


def main(
    count: tyro.conf.Positional[int],
    seed: tyro.conf.Positional[int] = 0,
    cases: tyro.conf.Positional[str] = "",
    out: tyro.conf.Positional[str] = "",
) -> None:
    """Identify `count` vehicles, and print the table; the arguments are those of `measure`."""
    names = cases.split(",") if cases else list(CASES)
    print("| log | number | estimated | covered | 95 % interval of that | half-width | pulls |")
    print("|---|---|---|---|---|---|---|")
    measured = measure(count, seed, names, out)
    for (case, key), rows in sorted(measured.items()):
        pull, width = (np.array([row[k] for row in rows]) for k in (1, 2))
        covered = int((np.abs(pull) < 1.0).sum())
        low, high = wilson(covered, len(rows))[1:]
        print(
            f"| {case} | `{key}` | {len(rows)} of {count} | {100 * covered / len(rows):.0f} % "
            f"| {100 * low:.0f} to {100 * high:.0f} % | {100 * np.median(width):.1f} % "
            f"| {pull.mean():.2f}, {np.sqrt((pull**2).mean()):.2f} |"
        )
    print("\n" + "\n".join(counts_table(measured, names)))


def counts_table(measured: Mapping[tuple[str, str], Sequence], cases: Sequence[str]) -> list[str]:
    """Return the lines of the table of covered and all intervals, and of their sums."""
    counts = {
        place: np.array([sum(abs(pull) < 1.0 for _, pull, _ in rows), len(rows)])
        for place, rows in measured.items()
    }
    lines = [f"| number | {' | '.join(cases)} |", "|---" * (len(cases) + 1) + "|"]
    for key in dict.fromkeys(key for _, key in sorted(measured)):
        entries = ("{}/{}".format(*counts.get((case, key), "--")) for case in cases)
        lines.append(f"| `{key}` | {' | '.join(entries).replace('-/-', '–')} |")
    covered, every = np.sum([*counts.values()], axis=0)
    return [*lines, f"\n{covered} of {every} intervals ({100 * covered / every:.1f} %)"]


if __name__ == "__main__":
    tyro.cli(main)

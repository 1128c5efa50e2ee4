"""Measure how often the 95 % intervals of `suite identify` contain the true value.

    python tools/coverage.py COUNT [SEED] [CASES] [OUT.json]

It estimates the parameters of COUNT simulated vehicles with random parameters
(`tests/support/fleets.py`). A case says which signals the logs have; CASES are separated by commas,
and all by default. For every parameter of a vehicle file the tool prints:

- for how many vehicles it was estimated,
- for how many of these the 95 % interval contains the true value, with Wilson's interval,
- the median half-width of the interval, relative to the true value,
- mean and root mean square of the pulls. A pull is an error divided by the half-width of the
  interval. For exact intervals the mean is 0 and the root mean square 0.51.
"""

from __future__ import annotations

import json
import sys
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from eval.flights.follow import FlightFailed, Recording
from eval.judging.statistics import wilson
from suite.diagnose.identify.identify import identify

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # for tests/support
from tests.support.fleets import (
    Fleet,
    Slow,
    drawn,
    logs_of,
    recordings_of,
    start,
    truths,
)

CASES = {
    "rotors": ("rotors", ()),
    "pwm": ("pwm", ()),
    "torques": ("torques", ()),
    "rates": ("rates", ()),
    "pwm without attitude": ("pwm", ("quat_wxyz",)),
    "pwm without rates": ("pwm", ("rate_b",)),
}
"""Case -> the logged input of the flights, and the signals that are removed from their logs."""


def pulls(
    fleet: Fleet, recordings: Sequence[Recording], case: str, rng: np.random.Generator
) -> dict[str, tuple[float, float]]:
    """Return name -> (pull, relative half-width) of every estimated parameter.

    Args:
        fleet: the true vehicle.
        recordings: flights of this vehicle.
        case: a key of `CASES`.
        rng: random generator of the noise of the logs.
    """
    drive, removed = CASES[case]
    logs = [
        replace(log, **{name: np.full_like(getattr(log, name), np.nan) for name in removed})
        for log in logs_of(fleet, recordings, drive, rng, Slow())
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

    Args:
        count: number of vehicles.
        seed: seed of the vehicles and the noise.
        cases: keys of `CASES`.
        out: JSON file to which the rows are also written; "" for none.
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
                rng = np.random.default_rng((seed, number, index))
                for key, pull in pulls(*fleet, case, rng).items():
                    rows[case, key].append((number, *pull))
        print(f"{done}: {time.monotonic() - start_s:.0f} s", file=sys.stderr, flush=True)
        if out:
            Path(out).write_text(json.dumps({f"{c} {k}": v for (c, k), v in rows.items()}))
    return rows


def main(count: int, seed: int, cases: Sequence[str], out: str) -> None:
    """Identify `count` vehicles, and print the table; the arguments are those of `measure`."""
    print("| log | number | estimated | covered | 95 % interval of that | half-width | pulls |")
    print("|---|---|---|---|---|---|---|")
    for (case, key), rows in sorted(measure(count, seed, cases, out).items()):
        pull, width = (np.array([row[k] for row in rows]) for k in (1, 2))
        covered = int((np.abs(pull) < 1.0).sum())
        low, high = wilson(covered, len(rows))[1:]
        print(
            f"| {case} | `{key}` | {len(rows)} of {count} | {100 * covered / len(rows):.0f} % "
            f"| {100 * low:.0f} to {100 * high:.0f} % | {100 * np.median(width):.1f} % "
            f"| {pull.mean():.2f}, {np.sqrt((pull**2).mean()):.2f} |"
        )


if __name__ == "__main__":
    words = sys.argv[1:] + ["0", "", ""][len(sys.argv) - 2 :]
    main(int(words[0]), int(words[1]), words[2].split(",") if words[2] else list(CASES), words[3])

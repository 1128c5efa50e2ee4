"""How often do the intervals of `suite identify` contain the true value, number by number?

    python tools/coverage.py COUNT [SEED] [CASES] [OUT.json]

Identifies COUNT simulated fleets of drawn numbers (`tests/support/fleets.py`) by each of
CASES (with commas between; else all). Prints, for every number of a vehicle file: for how many
fleets it was estimated, in how many of these the 95 % interval contains the true value (with
Wilson's interval), the median half-width over the true value, and the pulls (errors in
half-widths): mean and root mean square, 0 and 0.51 for exact intervals.
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
"""What drives the flights, and what their logs lack."""


def pulls(
    fleet: Fleet, recordings: Sequence[Recording], case: str, rng: np.random.Generator
) -> dict[str, tuple[float, float]]:
    """Return (error over half-width, half-width over truth) of every estimated number."""
    drive, lacks = CASES[case]
    logs = [
        replace(log, **{name: np.full_like(getattr(log, name), np.nan) for name in lacks})
        for log in logs_of(fleet, recordings, drive, rng, Slow())
    ]
    numbers = identify(logs, start()).numbers
    spans = {entry.key: entry.ci95 for entry in numbers}
    turned = [axis for axis, span in zip("xyz", spans.get("inertia", ()), strict=False) if span]
    true, off = truths(fleet, drive, "".join(turned)), {}
    for entry in numbers:
        for k, (value, span) in enumerate(zip(entry.value, entry.ci95, strict=True)):
            part = f"[{k}]" if len(entry.value) > 1 else ""
            if span is not None:
                half = 0.5 * (span[1] - span[0])
                size = true[entry.key][k]
                off[f"{entry.key}{part}"] = ((value - size) / half, half / abs(size))
    return off


def flown(seed: int, number: int) -> tuple[Fleet, list[Recording]] | None:
    """Return a fleet and its flights; None where they cannot be flown."""
    fleet = drawn(np.random.default_rng((seed, number)))
    try:
        return fleet, recordings_of(fleet)
    except FlightFailed:
        return None


def found(count: int, seed: int, cases: Sequence[str], out: str) -> dict[tuple[str, str], list]:
    """Return (number of the fleet, pull, half-width over truth) by case and number."""
    rows: dict[tuple[str, str], list] = defaultdict(list)
    begun, number, done = time.monotonic(), 0, 0
    while done < count:
        number += 1
        fleet = flown(seed, number)
        if fleet is None:
            continue
        done += 1
        for index, case in enumerate(CASES):
            if case in cases:
                rng = np.random.default_rng((seed, number, index))
                for key, pull in pulls(*fleet, case, rng).items():
                    rows[case, key].append((number, *pull))
        print(f"{done}: {time.monotonic() - begun:.0f} s", file=sys.stderr, flush=True)
        if out:
            Path(out).write_text(json.dumps({f"{c} {k}": v for (c, k), v in rows.items()}))
    return rows


def main(count: int, seed: int, cases: Sequence[str], out: str) -> None:
    """Identify, and print the table."""
    print("| log | number | estimated | held | 95 % interval of that | half-width | pulls |")
    print("|---|---|---|---|---|---|---|")
    for (case, key), rows in sorted(found(count, seed, cases, out).items()):
        pull, width = (np.array([row[k] for row in rows]) for k in (1, 2))
        held = int((np.abs(pull) < 1.0).sum())
        low, high = wilson(held, len(rows))[1:]
        print(
            f"| {case} | `{key}` | {len(rows)} of {count} | {100 * held / len(rows):.0f} % "
            f"| {100 * low:.0f} to {100 * high:.0f} % | {100 * np.median(width):.1f} % "
            f"| {pull.mean():.2f}, {np.sqrt((pull**2).mean()):.2f} |"
        )


if __name__ == "__main__":
    given = sys.argv[1:] + ["0", "", ""][len(sys.argv) - 2 :]
    main(int(given[0]), int(given[1]), given[2].split(",") if given[2] else list(CASES), given[3])

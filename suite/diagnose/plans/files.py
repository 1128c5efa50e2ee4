"""Commanded trajectories as files: one CSV of set points a flight, and what they are for.

`plan.json` holds the numbers that make each trajectory again; the CSV holds where to be, how fast,
how accelerated and where to look at every hundredth of a second, for autopilots that follow set
points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from suite.diagnose.plans.trajectory import Trajectory
from tracks.common.files import write_json, write_text
from tracks.common.provenance import stamp
from tracks.input.reading import read_json

SCHEMA = 1
"""Version of plan.json."""
RATE_HZ = 100.0
"""Of the set points."""
COLUMNS = (
    "time",
    *(f"{stem}_{axis}" for stem in ("pos", "vel", "acc") for axis in "xyz"),
    "yaw",
)
"""Of a CSV: s, m, m/s, m/s^2 in the world, and rad about world z."""
NAME = "plan.json"
KEYS = ("file", "flown")
"""Of a flight in it: its set points, and its log where it was flown in simulation."""


def remove_plan(folder: Path) -> None:
    """Remove what an earlier plan.json in `folder` lists, and itself; other files stay."""
    path = folder / NAME
    if not path.is_file():
        return
    try:
        listed = [flight.get(key) for flight in read_json(path)["flights"] for key in KEYS]
    except (ValueError, KeyError, TypeError, AttributeError):
        return  # none of ours; it is written over
    for name in listed:
        if isinstance(name, str) and (folder / name).resolve().is_relative_to(folder.resolve()):
            (folder / name).unlink(missing_ok=True)
    path.unlink()


def write_plan(folder: Path, ways: Sequence[Trajectory], words: Sequence[str]) -> dict[str, Any]:
    """Write `ways`, one a flight, in `folder`; return what plan.json holds.

    `words` say to people what the flights are for.
    """
    folder.mkdir(parents=True, exist_ok=True)
    flights = []
    for number, way in enumerate(ways, 1):
        name = f"{number}_{way.kind}.csv"
        time_s = np.arange(0.0, way.duration_s + 0.5 / RATE_HZ, 1.0 / RATE_HZ)
        wanted = way.reference(time_s)
        table = np.column_stack([time_s, wanted.pos_w, wanted.vel_w, wanted.acc_w, wanted.yaw])
        rows = [",".join(COLUMNS), *(",".join(f"{v:.6g}" for v in row) for row in table)]
        write_text(folder / name, "\n".join(rows) + "\n")
        flights.append(
            {
                "file": name,
                "trajectory": asdict(way),
                "room": np.ptp(wanted.pos_w, axis=0).tolist(),
                "top_speed": float(np.linalg.norm(wanted.vel_w, axis=1).max()),
                "top_acceleration": float(np.linalg.norm(wanted.acc_w, axis=1).max()),
                "flown": None,
            }
        )
    plan = {"flights": flights, "words": list(words)}
    write_json(folder / NAME, {**plan, **stamp(SCHEMA, None)})
    return plan

"""Add measurement noise to the recorded flights of a loop, and cut each one before a contact.

The records of a simulation are exact. The noise is that of a typical state estimator: without it
the diagnosis would use a precision that real logs do not have.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from eval.logs.flight_log import FlightLog, read_flights, write_flight
from suite.delta.log_rows import take_rows
from suite.judging.collect import LIST
from tracks.common.files import write_json
from tracks.geometry.rotation import exp_rot, rot_to_quat

CONTACT_MARGIN_S = 0.1
"""Time that is cut off the end of a flight that ended by a contact [s]."""
SHORTEST_S = 1.5
"""Shortest flight that is used [s]."""
LEAST_FILES = 5
"""Smallest number of flights for a diagnosis: its statistics take whole flights as independent."""
NOISE = {"pos": 0.005, "attitude": 0.004, "vel": 0.03, "gyro": 0.02, "rotor": 5.0}
"""Standard deviations of the white noise of position [m], attitude [rad], velocity [m/s] and body
rates [rad/s], on each axis, and of the speed of each rotor [rad/s]."""


def add_measurement_noise(flights: Path, out: Path, seed: int) -> list[Path]:
    """Write the flights of `suite collect` in `flights` with measurement noise into `out`.

    Returns:
        The written files: the first of each track and level, then the second of each, and so on.
        So a number of first files covers all tracks and levels.

    Raises:
        ValueError: if no flight is long enough.
    """
    rows = json.loads((flights / LIST).read_text(encoding="utf-8"))["flights"]
    rng = np.random.default_rng([seed, 7])
    cells: dict[tuple[str, int], list[Path]] = {}
    out.mkdir(parents=True, exist_ok=True)
    for row in rows:
        if row["file"] is None:
            continue
        log = read_flights([flights / row["file"]])[0][0]
        has_contact = row["ended_by"] not in ("finished", "timeout")
        log = noisy(cut_end(log, CONTACT_MARGIN_S if has_contact else 0.0), rng)
        # The diagnosis would warn that the hidden vehicle has another name than the simulation's.
        log = replace(log, about={k: v for k, v in log.about.items() if k != "vehicle"})
        if log.duration_s < SHORTEST_S:
            continue
        write_flight(out / row["file"], log)
        cells.setdefault((row["track"], row["difficulty"]), []).append(out / row["file"])
    most = max((len(files) for files in cells.values()), default=0)
    files = [cell[k] for k in range(most) for cell in cells.values() if k < len(cell)]
    if not files:
        raise ValueError(f"no flight in {flights} is {SHORTEST_S:g} s long")
    write_json(out / "measured.json", {"noise": NOISE, "files": [file.name for file in files]})
    return files


def cut_end(log: FlightLog, margin_s: float) -> FlightLog:
    """Return a log without the last `margin_s` [s]."""
    return take_rows(log, log.time_s <= log.time_s[-1] - margin_s)


def noisy(log: FlightLog, rng: np.random.Generator) -> FlightLog:
    """Return a log with white noise on all measurements, and with exact commands and actions."""

    def with_noise(values: np.ndarray, sigma: float) -> np.ndarray:
        return values + sigma * rng.standard_normal(values.shape)

    turn_b = NOISE["attitude"] * rng.standard_normal((len(log.time_s), 3))
    rotors = log.rotor_speed
    return replace(
        log,
        pos_w=with_noise(log.pos_w, NOISE["pos"]),
        quat_wxyz=rot_to_quat(log.rot_w @ exp_rot(turn_b)),
        vel_w=with_noise(log.vel_w, NOISE["vel"]),
        rate_b=with_noise(log.rate_b, NOISE["gyro"]),
        # A rotor speed is never negative.
        rotor_speed=None if rotors is None else np.maximum(with_noise(rotors, NOISE["rotor"]), 0.0),
    )


def first_files(files: Sequence[Path], duration_s: float) -> list[Path]:
    """Return as many of the first `files` as last `duration_s` [s] in total, or `LEAST_FILES`."""
    logs, _ = read_flights(list(files))
    durations_s = {Path(log.name).name: log.duration_s for log in logs}
    selected, total_s = [], 0.0
    for file in files:
        if total_s >= duration_s and len(selected) >= LEAST_FILES:
            break
        selected.append(file)
        total_s += durations_s.get(file.name, 0.0)
    return selected

"""Held-out flights measured and simulated, before and after, as a recording for rerun."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from eval.view.comparison import Compared, Simulation, Track, write_comparison
from suite.diagnose.data.windows import LENGTH_S, Windows, cut, take
from suite.diagnose.diagnose import Diagnosis
from suite.diagnose.verdict.gap import true_starts
from tracks.geometry.rotation import exp_rot, rot_to_quat

MOST = 4
"""Held-out flights in a recording."""


def write_rollouts(
    path: Path, result: Diagnosis, logs: Sequence[FlightLog], vehicle: Vehicle
) -> Path:
    """Write rollouts of 1 s over what was held out, as given and with what was named.

    Args:
        path: file to write, ending in `.rrd`.
        result: the diagnosis of `logs`.
        logs: the flights.
        vehicle: the one that the simulation used.

    Raises:
        OSError: where the file cannot be written; nothing is left under its name.
    """
    windows, _ = cut(logs, vehicle, result.driven_by != "commands", LENGTH_S)
    assert windows is not None  # the diagnosis has cut them before
    held = result.held
    first_s = float(np.min(held.start_s)) if len(np.unique(windows.flight)) == 1 else 0.0
    chosen = np.isin(windows.flight, np.unique(held.flight)[:MOST])
    chosen &= np.asarray(windows.start_s) >= first_s - 1e-6
    windows = take(windows, chosen)
    start = result.model.space.array("start")
    series = [("simulated as given", start)]
    if result.finding.named:
        series.append(("simulated with what was named", result.finding.state.theta))
    simulated = {}
    for label, theta in series:
        offset = true_starts(result.model, theta, windows)
        simulated[label] = result.model.residual(theta, offset, windows)
    flights = []
    for number in np.unique(windows.flight):
        rows = np.flatnonzero(windows.flight == number)
        simulations = []
        for label, residual in simulated.items():
            found = [_rollout(take(windows, row), residual[row]) for row in rows]
            found = [one for one in found if one is not None]
            tracks, errors = [one[0] for one in found], [one[1] for one in found]
            simulations.append(Simulation(label, tracks, errors))
        log = logs[int(number)]
        flights.append(Compared(log.name, _measured(log, first_s), simulations))
    return write_comparison(path, flights, vehicle.body.half_size)


def _measured(log: FlightLog, first_s: float) -> Track:
    time_s = log.time_s - log.time_s[0]
    rows = time_s >= first_s - 1e-6
    fields = (time_s, log.pos_w, log.quat_wxyz, log.vel_w, log.rate_b)
    return Track(*(field[rows] for field in fields))


def _rollout(window: Windows, residual: np.ndarray) -> tuple[Track, np.ndarray] | None:
    """Return one rollout and its errors (T, 4) at the rows with a pose; None where it diverged."""
    seen = np.asarray(window.seen)
    rows = seen[:, 0] & seen[:, 3]
    if rows.sum() < 2 or not np.isfinite(residual[rows]).all():
        return None
    error = np.where(seen, residual, np.nan)[rows]
    sine = np.linalg.norm(error[:, 3:6], axis=1, keepdims=True)
    angle = np.arcsin(np.clip(sine, 0.0, 1.0))
    # The attitude's error is the sine of the angle that is left to what was measured.
    turn = -error[:, 3:6] * angle / np.maximum(sine, 1e-12)
    rot_w = np.asarray(window.row_rot_w)[rows] @ exp_rot(turn)
    track = Track(
        window.start_s + np.asarray(window.row_s)[rows],
        np.asarray(window.row_pos_w)[rows] - error[:, :3],
        rot_to_quat(rot_w),
        np.asarray(window.row_vel_w)[rows] - error[:, 6:9],
        np.asarray(window.row_rate_b)[rows] - error[:, 9:12],
    )
    lengths = [np.linalg.norm(error[:, at], axis=1) for at in (slice(0, 3), slice(6, 9))]
    errors = np.stack(
        [*lengths, np.rad2deg(angle[:, 0]), np.linalg.norm(error[:, 9:12], axis=1)], axis=1
    )
    return track, errors

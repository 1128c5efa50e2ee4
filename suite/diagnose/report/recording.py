"""Held-out flights measured and simulated, before and after, as a recording for rerun."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.view.comparison import Compared, Simulation, Track, write_comparison
from suite.diagnose.data.windows import LENGTH_S, FlightWindows, take
from suite.diagnose.verdict.diagnosis import Diagnosis
from suite.diagnose.verdict.gap import true_starts
from tracks.geometry.rotation import exp_rot, rot_to_quat

MOST = 4
"""Held-out flights in a recording."""


def write_rollouts(path: Path, diagnosis: Diagnosis) -> Path:
    """Write rollouts of 1 s over what was held out, as given and with what was named, as `.rrd`.

    Raises:
        OSError: where the file cannot be written; nothing is left under its name.
    """
    model, windows, held = diagnosis.model, diagnosis.cut(LENGTH_S), diagnosis.held_windows
    first_s = float(np.min(held.start_s)) if len(np.unique(windows.flight)) == 1 else 0.0
    chosen = np.isin(windows.flight, np.unique(held.flight)[:MOST])
    chosen &= np.asarray(windows.start_s) >= first_s - 1e-6
    windows = take(windows, chosen)
    series = [("simulated as given", diagnosis.start)]
    if diagnosis.fitted is not None:
        series.append(("simulated with what was named", diagnosis.fitted))
    simulated = {
        label: model.residual(theta, true_starts(model, theta, windows), windows)
        for label, theta in series
    }
    flights = []
    for number in np.unique(windows.flight):
        rows = np.flatnonzero(windows.flight == number)
        simulations = []
        for label, residual in simulated.items():
            found = [_rollout(take(windows, row), residual[row]) for row in rows]
            whole = [one for one in found if one is not None]
            tracks, errors = [one[0] for one in whole], [one[1] for one in whole]
            simulations.append(Simulation(label, tracks, errors))
        log = diagnosis.logs[int(number)]
        flights.append(Compared(log.name, _measured(log, first_s), simulations))
    return write_comparison(path, flights, diagnosis.nominal.body.half_size)


def _measured(log: FlightLog, first_s: float) -> Track:
    time_s = log.time_s - log.time_s[0]
    rows = time_s >= first_s - 1e-6
    fields = (time_s, log.pos_w, log.quat_wxyz, log.vel_w, log.rate_b)
    return Track(*(field[rows] for field in fields))


def _rollout(window: FlightWindows, residual: np.ndarray) -> tuple[Track, np.ndarray] | None:
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

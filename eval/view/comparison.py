"""Recordings of measured and simulated flights together, for the rerun viewer.

A flight has the entities `/flight_k/world/measured`, and `world/LABEL` for each simulation, each
with its `path` and a moving `drone`; the series `error/LABEL/position`, `.../velocity`,
`.../attitude` and `.../rates`, and `velocity_x/measured`, `velocity_x/LABEL`, ... on the timeline
`time` in seconds from the flight's start. A simulation consists of rollouts; lines break between
them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from eval.view.blueprint import tabbed
from eval.view.recording import APPLICATION, DRONE_HALF_SIZE, time_columns
from tracks.common.files import replacing_file
from tracks.common.provenance import stamp

SCHEMA = 1
"""Version of the recording's entities, in its properties."""
MEASURED = (29, 36, 48)
SIMULATED = ((224, 137, 43), (36, 99, 201), (122, 92, 184))
"""Colours of the simulations, in order."""
ERRORS = {"position": "m", "velocity": "m/s", "attitude": "deg", "rates": "rad/s"}
SERIES = tuple(f"{group}_{axis}" for group in ("velocity", "rates") for axis in "xyz")


class Track(NamedTuple):
    """Measured or simulated states of a drone at T times; NaN where unknown."""

    time_s: np.ndarray
    """(T,) since the flight's start [s]."""
    pos_w: np.ndarray
    """(T, 3) [m]."""
    quat_wxyz: np.ndarray
    """(T, 4)."""
    vel_w: np.ndarray
    """(T, 3) [m/s]."""
    rate_b: np.ndarray
    """(T, 3) [rad/s]."""


class Simulation(NamedTuple):
    """One simulation of a flight, in rollouts that start from measured states."""

    label: str
    """Name in the viewer."""
    rollouts: Sequence[Track]
    """One after another in time."""
    errors: Sequence[np.ndarray]
    """(T, 4) of each rollout: simulated less measured of position, velocity [m, m/s], attitude
    [deg] and rates [rad/s], as lengths."""


class Compared(NamedTuple):
    """One measured flight and its simulations."""

    name: str
    measured: Track
    simulations: Sequence[Simulation]


def write_comparison(
    path: str | Path,
    flights: Sequence[Compared],
    half_size: tuple[float, float, float] = DRONE_HALF_SIZE,
) -> Path:
    """Write flights and their simulations as a rerun recording (.rrd) with a layout.

    Args:
        path: file to write, ending in `.rrd`.
        flights: each gets a tab.
        half_size: half extents of the drone's box [m].

    Raises:
        ValueError: where there is no flight.
        OSError: where the file cannot be written; nothing is left under its name.
    """
    if not flights:
        raise ValueError("a recording needs at least one flight; got none")
    recording = rr.RecordingStream(APPLICATION)
    with replacing_file(path) as temporary:
        recording.save(temporary, default_blueprint=_layout(flights))
        try:
            texts = {k: str(v) for k, v in stamp(SCHEMA, None).items() if v is not None}
            recording.send_property("suite", rr.AnyValues(drop_untyped_nones=True, **texts))
            for number, flight in enumerate(flights):
                _log_flight(recording, f"/flight_{number}", flight, half_size)
            recording.flush()
        finally:
            recording.disconnect()
    return Path(path)


def _log_flight(
    recording: rr.RecordingStream,
    root: str,
    flight: Compared,
    half_size: tuple[float, float, float],
) -> None:
    world = f"{root}/world"
    recording.log(world, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_drone(recording, f"{world}/measured", [flight.measured], MEASURED, half_size, "measured")
    _log_series(recording, root, "measured", flight.measured, MEASURED, 2.0)
    for simulation, colour in zip(flight.simulations, SIMULATED, strict=False):
        label = rr.escape_entity_path_part(simulation.label)
        entity = f"{world}/{label}"
        _log_drone(recording, entity, simulation.rollouts, colour, half_size, simulation.label)
        if not simulation.rollouts:
            continue
        whole = Track(*(_broken(parts) for parts in zip(*simulation.rollouts, strict=True)))
        _log_series(recording, root, label, whole, colour, 1.2)
        errors = _broken(simulation.errors)
        for k, name in enumerate(ERRORS):
            line = f"{root}/error_{name}/{label}"
            _log_line(recording, line, whole.time_s, errors[:, k], simulation.label, colour, 1.5)


def _log_drone(
    recording: rr.RecordingStream,
    entity: str,
    tracks: Sequence[Track],
    colour: tuple[int, int, int],
    half_size: tuple[float, float, float],
    label: str,
) -> None:
    strips = [track.pos_w[np.isfinite(track.pos_w).all(axis=1)] for track in tracks]
    strips = [strip for strip in strips if len(strip) > 1]
    lines = rr.LineStrips3D(strips, colors=[colour] * len(strips), radii=0.012)
    recording.log(f"{entity}/path", lines, static=True)
    if not tracks:
        return
    track = Track(*(np.concatenate(parts) for parts in zip(*tracks, strict=True)))
    good = np.isfinite(track.pos_w).all(axis=1) & np.isfinite(track.quat_wxyz).all(axis=1)
    columns = rr.Transform3D.columns(
        translation=track.pos_w[good], quaternion=np.roll(track.quat_wxyz[good], -1, axis=1)
    )
    recording.send_columns(f"{entity}/drone", time_columns(track.time_s[good]), columns)
    body = rr.Boxes3D(half_sizes=[half_size], colors=[colour], labels=[label])
    recording.log(f"{entity}/drone/body", body, static=True)


def _log_series(
    recording: rr.RecordingStream,
    root: str,
    label: str,
    track: Track,
    colour: tuple[int, int, int],
    width: float,
) -> None:
    values = np.concatenate([track.vel_w, track.rate_b], axis=1)
    for k, name in enumerate(SERIES):
        line = f"{root}/{name}/{label}"
        _log_line(recording, line, track.time_s, values[:, k], label, colour, width)


def _log_line(
    recording: rr.RecordingStream,
    entity: str,
    time_s: np.ndarray,
    values: np.ndarray,
    label: str,
    colour: tuple[int, int, int],
    width: float,
) -> None:
    style = rr.SeriesLines(names=[label], colors=[colour], widths=[width])
    recording.log(entity, style, static=True)
    columns = rr.Scalars.columns(scalars=np.asarray(values, dtype=np.float64))
    recording.send_columns(entity, time_columns(time_s), columns)


def _broken(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return `parts` joined, with a row of NaN between them; times continue."""
    rows: list[np.ndarray] = []
    for number, part in enumerate(parts):
        rows.append(part)
        if number + 1 < len(parts):
            gap = part[-1:] + 1e-6 if part.ndim == 1 else np.full_like(part[-1:], np.nan)
            rows.append(gap)
    return np.concatenate(rows)


def _layout(flights: Sequence[Compared]) -> rrb.Blueprint:
    times = [flight.measured.time_s for flight in flights]
    # The start is skipped, where simulations still agree with the measurement.
    shown = (0.1 * float(times[0][-1]), max(float(time[-1]) for time in times))
    return tabbed([_tab(f"/flight_{number}", f) for number, f in enumerate(flights)], shown)


def _tab(root: str, flight: Compared) -> rrb.Vertical:
    overview = rrb.Spatial3DView(
        origin=f"{root}/world",
        name="measured and simulated",
        background=[245, 246, 248],
        line_grid=False,
    )
    errors = [
        rrb.TimeSeriesView(origin=f"{root}/error_{name}", name=f"{name} error [{unit}]")
        for name, unit in ERRORS.items()
    ]
    units = {"velocity": "m/s", "rates": "rad/s"}
    series = [
        rrb.TimeSeriesView(origin=f"{root}/{name}", name=f"{name.replace('_', ' ')} [{unit}]")
        for name in SERIES
        for unit in [units[name.split("_")[0]]]
    ]
    return rrb.Vertical(
        rrb.Horizontal(overview, rrb.Vertical(*errors), column_shares=[1.6, 1.0]),
        rrb.Horizontal(*series[:3]),
        rrb.Horizontal(*series[3:]),
        row_shares=[3.0, 1.0, 1.0],
        name=flight.name,
    )

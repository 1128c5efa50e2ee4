"""Write measured flights with their simulations as a recording for the rerun 3D viewer.

The entities of flight k are below `/flight_k`: `world/measured`, and `world/LABEL` for each
simulation, each with a `path` and a moving `drone`. Its curves are `error_position/LABEL`,
`error_velocity/LABEL`, `error_attitude/LABEL`, `error_rates/LABEL`, and `velocity_x/measured`,
`velocity_x/LABEL`, ... on the timeline `time` in seconds from the start of the flight. A simulation
consists of rollouts, which start from measured states; lines break between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from eval.view.blueprint import BACKGROUND, tabs_blueprint
from eval.view.recording import log_curves, open_recording, time_columns
from eval.view.solids import DRONE_HALF_SIZE
from tracks.common.provenance import stamp

SCHEMA = 1
"""Version of the recording's entities, which is stored in its properties."""
MEASURED = (29, 36, 48)
"""Colour of the measured flight, 0-255."""
SIMULATED = ((224, 137, 43), (36, 99, 201), (122, 92, 184))
"""Colours of the simulations, in order; a fourth one has the first colour again."""
ERRORS = {"position": "m", "velocity": "m/s", "attitude": "deg", "rates": "rad/s"}
"""Part of the state -> unit of its error."""
SERIES = tuple(f"{group}_{axis}" for group in ("velocity", "rates") for axis in "xyz")
"""Names of the curves: velocity and body rates, along each axis."""


class States(NamedTuple):
    """Measured or simulated states of a drone at T times; NaN where unknown."""

    time_s: np.ndarray
    """(T,) time since the start of the flight [s]."""
    pos_w: np.ndarray
    """(T, 3) position [m]."""
    quat_wxyz: np.ndarray
    """(T, 4) attitude, body to world."""
    vel_w: np.ndarray
    """(T, 3) velocity [m/s]."""
    rate_b: np.ndarray
    """(T, 3) body rates [rad/s]."""


class Simulation(NamedTuple):
    """One simulation of a flight, in rollouts that start from measured states."""

    label: str
    """Name in the viewer."""
    rollouts: Sequence[States]
    """The simulated states of each rollout, in the order of time."""
    errors: Sequence[np.ndarray]
    """Errors (T, 4) of each rollout: norms of simulated minus measured position [m], velocity
    [m/s], attitude [deg] and body rates [rad/s]."""


class ComparedFlight(NamedTuple):
    """One measured flight and its simulations."""

    name: str
    measured: States
    simulations: Sequence[Simulation]


def write_comparison(
    path: str | Path,
    flights: Sequence[ComparedFlight],
    half_size: tuple[float, float, float] = DRONE_HALF_SIZE,
) -> Path:
    """Write flights and their simulations as a rerun recording (.rrd) with a layout.

    Each flight gets a tab. `half_size` are half extents of the drone's box [m].

    Raises:
        ValueError: where `flights` is empty.
        OSError: where the file cannot be written; nothing is left under its name.
    """
    if not flights:
        raise ValueError("a recording needs at least one flight; got none")
    with open_recording(path, _layout(flights), stamp(SCHEMA, None)) as recording:
        for number, flight in enumerate(flights):
            _log_flight(recording, f"/flight_{number}", flight, half_size)
    return Path(path)


def _log_flight(
    recording: rr.RecordingStream,
    root: str,
    flight: ComparedFlight,
    half_size: tuple[float, float, float],
) -> None:
    """Log a flight, its simulations and their errors below the entity `root`."""
    world = f"{root}/world"
    recording.log(world, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_drone(recording, f"{world}/measured", [flight.measured], MEASURED, half_size, "measured")
    _log_series(recording, root, "measured", flight.measured, MEASURED, 2.0)
    for simulation, colour in zip(flight.simulations, cycle(SIMULATED), strict=False):
        label = rr.escape_entity_path_part(simulation.label)
        entity = f"{world}/{label}"
        _log_drone(recording, entity, simulation.rollouts, colour, half_size, simulation.label)
        if not simulation.rollouts:
            continue
        states = States(
            *(_concatenate_with_gaps(parts) for parts in zip(*simulation.rollouts, strict=True))
        )
        _log_series(recording, root, label, states, colour, 1.2)
        errors = _concatenate_with_gaps(simulation.errors)
        for k, name in enumerate(ERRORS):
            style = rr.SeriesLines(names=[simulation.label], colors=[colour], widths=[1.5])
            line = f"{root}/error_{name}/{label}"
            log_curves(recording, line, states.time_s, errors[:, k], style)


def _log_drone(
    recording: rr.RecordingStream,
    entity: str,
    rollouts: Sequence[States],
    colour: tuple[int, int, int],
    half_size: tuple[float, float, float],
    label: str,
) -> None:
    """Log the path of each rollout, and a drone that moves through all of them."""
    strips = [states.pos_w[np.isfinite(states.pos_w).all(axis=1)] for states in rollouts]
    strips = [strip for strip in strips if len(strip) > 1]
    lines = rr.LineStrips3D(strips, colors=[colour] * len(strips), radii=0.012)
    recording.log(f"{entity}/path", lines, static=True)
    if not rollouts:
        return
    states = States(*(np.concatenate(parts) for parts in zip(*rollouts, strict=True)))
    known = np.isfinite(states.pos_w).all(axis=1) & np.isfinite(states.quat_wxyz).all(axis=1)
    columns = rr.Transform3D.columns(
        translation=states.pos_w[known], quaternion=np.roll(states.quat_wxyz[known], -1, axis=1)
    )
    recording.send_columns(f"{entity}/drone", time_columns(states.time_s[known]), columns)
    body = rr.Boxes3D(half_sizes=[half_size], colors=[colour], labels=[label])
    recording.log(f"{entity}/drone/body", body, static=True)


def _log_series(
    recording: rr.RecordingStream,
    root: str,
    label: str,
    states: States,
    colour: tuple[int, int, int],
    width: float,
) -> None:
    """Log velocity and body rates as curves, one for each axis."""
    values = np.concatenate([states.vel_w, states.rate_b], axis=1)
    style = rr.SeriesLines(names=[label], colors=[colour], widths=[width])
    for k, name in enumerate(SERIES):
        log_curves(recording, f"{root}/{name}/{label}", states.time_s, values[:, k], style)


def _concatenate_with_gaps(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return the concatenated `parts`, with a row of NaN (for times, 1 us later) between them."""
    rows: list[np.ndarray] = []
    for number, part in enumerate(parts):
        rows.append(part)
        if number + 1 < len(parts):
            gap = part[-1:] + 1e-6 if part.ndim == 1 else np.full_like(part[-1:], np.nan)
            rows.append(gap)
    return np.concatenate(rows)


def _layout(flights: Sequence[ComparedFlight]) -> rrb.Blueprint:
    """Return the layout of the recording, with a tab for each flight."""
    times = [flight.measured.time_s for flight in flights]
    # The playback skips the start, where simulations still agree with the measurement.
    first_s, last_s = float(times[0][0]), float(times[0][-1])
    playback_s = (0.9 * first_s + 0.1 * last_s, max(float(time[-1]) for time in times))
    views = [_flight_view(f"/flight_{number}", flight) for number, flight in enumerate(flights)]
    return tabs_blueprint(views, playback_s)


def _flight_view(root: str, flight: ComparedFlight) -> rrb.Vertical:
    """Return the views of one flight: paths, and errors and curves of what was logged."""
    overview = rrb.Spatial3DView(
        origin=f"{root}/world",
        name="measured and simulated",
        background=BACKGROUND,
        line_grid=False,
    )
    states = [flight.measured, *(part for one in flight.simulations for part in one.rollouts)]
    curves = {
        group: rrb.Horizontal(
            *(
                rrb.TimeSeriesView(origin=f"{root}/{name}", name=f"{group} {name[-1]} [{unit}]")
                for name in SERIES
                if name.startswith(group)
            )
        )
        for group, unit, field in (("velocity", "m/s", "vel_w"), ("rates", "rad/s", "rate_b"))
        if any(np.isfinite(getattr(each, field)).any() for each in states)
    }
    parts = [part for one in flight.simulations for part in one.errors]
    errors = [
        rrb.TimeSeriesView(origin=f"{root}/error_{name}", name=f"{name} error [{unit}]")
        for k, (name, unit) in enumerate(ERRORS.items())
        if any(np.isfinite(part[:, k]).any() for part in parts)
    ]
    top = [overview, rrb.Vertical(*errors)] if errors else [overview]
    return rrb.Vertical(
        rrb.Horizontal(*top, column_shares=[1.6, 1.0][: len(top)]),
        *curves.values(),
        row_shares=[3.0, *(1.0 for _ in curves)],
        name=flight.name,
    )

"""Find probable mistakes in a track from a file: units of lengths and angles, and wrong places."""

from __future__ import annotations

import numpy as np

from tracks.track import Track

OPENING_MOST_M, STEP_MOST_M = 20.0, 200.0
"""Largest plausible opening of a gate, and distance between gates that follow each other [m]."""
QUARTER_DEG = np.pi / 4
"""A yaw of 45 deg, if it is written in radians [deg]."""
ROUNDING = 0.005
"""Largest rounding of an angle that is written in radians [deg]."""
STEP_LEAST_M = 0.3
"""Smallest plausible distance between different gates that follow each other [m]."""
AGAINST = -0.7
"""A gate is turned round if the cosines of its direction with the ways to and from it are less."""
AWAY, TOWARDS = 0.7, 0.9
"""Cosines of the start's heading with the way to gate 0: surely away, and surely towards it."""


def track_notes(name: str, track: Track) -> list[str]:
    """Return notes, as sentences, on what is probably a mistake in the track `name`."""
    gates, notes = track.scene.gates, []
    center_w, ahead_w = gates.center_w, gates.rot_w[:, :, 0]
    opening_m = float(np.ptp(gates.opening_g, axis=1).max())
    step_m = float(np.linalg.norm(np.diff(center_w, axis=0), axis=1).max(initial=0.0))
    if opening_m > OPENING_MOST_M or step_m > STEP_MOST_M:
        notes.append(
            f"its largest gate is {opening_m:g} m wide and gates are up to {step_m:g} m apart; is "
            "the file in centimetres or millimetres? Lengths are in metres"
        )
    yaw_deg = np.rad2deg(np.arctan2(ahead_w[:, 1], ahead_w[:, 0]))
    written = _in_radians(yaw_deg)
    if written.any() and np.abs(yaw_deg).max() < 2.0 * np.pi + ROUNDING:
        gate = int(np.argmax(written))
        notes.append(f"gate {gate} has a yaw of {yaw_deg[gate]:.4g} deg; is yaw_deg in radians?")
    way_w = np.diff(np.vstack([track.start_pos_w, center_w]), axis=0)  # to each gate
    length_m = np.linalg.norm(way_w, axis=1)
    way_w = way_w / np.maximum(length_m, 1e-9)[:, None]
    start_deg = np.rad2deg(track.start_yaw)
    # The cosines for the yaw as read, and for radians that were written as degrees.
    heading = [
        np.array([np.cos(yaw), np.sin(yaw)]) @ way_w[0, :2] for yaw in (track.start_yaw, start_deg)
    ]
    if _in_radians(start_deg) and heading[0] < AWAY and heading[1] > TOWARDS:
        notes.append(f"the start has a yaw of {start_deg:.4g} deg; is start.yaw_deg in radians?")
    for gate in np.flatnonzero((length_m[1:] > 1e-3) & (length_m[1:] < STEP_LEAST_M))[:1]:
        apart_m = length_m[gate + 1]
        notes.append(f"gates {gate} and {gate + 1} are only {apart_m:.2g} m apart; in metres?")
    cosine = (way_w * ahead_w).sum(axis=1), (way_w[1:] * ahead_w[:-1]).sum(axis=1)
    for gate in np.flatnonzero((cosine[0][:-1] < AGAINST) & (cosine[1] < AGAINST))[:1]:
        notes.append(f"gate {gate} faces against the path to and from it; turn its yaw by 180 deg?")
    # A gate may be listed again, for another lap, but not next to itself.
    step_w, turn = np.diff(center_w, axis=0), (ahead_w[1:] * ahead_w[:-1]).sum(axis=1)
    for gate in np.flatnonzero((np.linalg.norm(step_w, axis=1) < 1e-3) & (turn > 0.999))[:1]:
        notes.append(f"gates {gate} and {gate + 1} have the same place and direction")
    return [f"{name}: {note}" for note in [*notes, *_blocked(track)]]


def _in_radians(yaw_deg: np.ndarray | float) -> np.ndarray:
    """Return which yaws [deg], but for 0, are a multiple of 45 deg if they were radians."""
    quarters = np.round(np.divide(yaw_deg, QUARTER_DEG))
    return (quarters != 0) & (np.abs(yaw_deg - quarters * QUARTER_DEG) < ROUNDING)


def _blocked(track: Track) -> list[str]:
    """Return a note on a solid that contains a gate's centre."""
    # Imported here, because trimesh takes long to import and only custom tracks need it.
    from tracks.formats.custom import is_inside
    from tracks.formats.meshes import solid_meshes

    for name, mesh in solid_meshes(track):
        for gate in np.flatnonzero(is_inside(mesh, track.scene.gates.center_w))[:1]:
            return [f"the centre of gate {gate} is inside {name!r}"]
    return []

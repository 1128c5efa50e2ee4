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


def track_notes(name: str, track: Track) -> list[str]:
    """Return notes, as sentences, on what is probably a mistake in the track `name`."""
    gates, notes = track.scene.gates, []
    center_w, ahead_w = gates.center_w, gates.rot_w[:, :, 0]
    opening_m = float(np.ptp(gates.opening_g, axis=1).max())
    step_m = float(np.linalg.norm(np.diff(center_w, axis=0), axis=1).max(initial=0.0))
    if opening_m > OPENING_MOST_M or step_m > STEP_MOST_M:
        notes.append(
            f"its largest gate is {opening_m:g} m wide and gates are up to {step_m:g} m apart; is "
            "the file in millimetres? Lengths are in metres"
        )
    yaw_deg = np.rad2deg(np.arctan2(ahead_w[:, 1], ahead_w[:, 0]))
    quarters = np.round(yaw_deg / QUARTER_DEG)
    written = (quarters != 0) & (np.abs(yaw_deg - quarters * QUARTER_DEG) < ROUNDING)
    if written.any() and np.abs(yaw_deg).max() < 2.0 * np.pi + ROUNDING:
        gate = int(np.argmax(written))
        notes.append(f"gate {gate} has a yaw of {yaw_deg[gate]:.4g} deg; is yaw_deg in radians?")
    # A gate may be listed again, for another lap, but not next to itself.
    step_w, turn = np.diff(center_w, axis=0), (ahead_w[1:] * ahead_w[:-1]).sum(axis=1)
    for gate in np.flatnonzero((np.linalg.norm(step_w, axis=1) < 1e-3) & (turn > 0.999))[:1]:
        notes.append(f"gates {gate} and {gate + 1} have the same place and direction")
    return [f"{name}: {note}" for note in [*notes, *_blocked(track)]]


def _blocked(track: Track) -> list[str]:
    """Return a note on a solid that contains a gate's centre."""
    # Imported here, because trimesh takes long to import and only custom tracks need it.
    from tracks.formats.custom import is_inside
    from tracks.formats.meshes import solid_meshes

    for name, mesh in solid_meshes(track):
        for gate in np.flatnonzero(is_inside(mesh, track.scene.gates.center_w))[:1]:
            return [f"the centre of gate {gate} is inside {name!r}"]
    return []

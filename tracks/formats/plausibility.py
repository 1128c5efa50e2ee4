"""Find probable mistakes in a track from a file: units of lengths and angles, and wrong places."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tracks.formats.custom import OPENING_MOST_M, START_BEHIND_M
from tracks.geometry.scene import Gates
from tracks.track import Track

if TYPE_CHECKING:
    import trimesh

STEP_MOST_M = 200.0
"""Largest plausible distance between gates that follow each other, of the start from gate 0, and of
a solid from all of these [m]."""
FRAME_MOST_M = 5.0
"""Largest plausible width and depth of a gate's frame, the largest of a race are about 1 m [m]."""
THICK_MOST_M = 30.0
"""Largest plausible size of a solid along its thinnest side; the thinnest of a building is less,
and an object of 0.3 m has it if centimetres are read as metres [m]."""
CLEAR_M = 0.5
"""Distance before and after a gate's centre that a drone cannot fly round [m]."""
IN_OPENING, INSIDE_M = 0.9, 0.1
"""A frame stands in an opening where it meets this share of it, within this distance of its plane
[m]. Frames of neighbours may touch."""
QUARTER_DEG = np.pi / 4
"""A yaw of 45 deg, if it is written in radians [deg]."""
ROUNDING = 0.005
"""Largest rounding of an angle that is written in radians [deg]."""
STEP_LEAST_M = 0.3
"""Smallest plausible distance between different gates that follow each other [m]."""
AGAINST = -0.7
"""Cosine of a gate's direction with the path below which it is turned round."""
ACROSS, ACROSS_AT_END = 0.2, 0.1
"""Cosines of a gate's yaw with the path below which the gate is turned, and of one at an end of the
path, which has a way on one side only. On the families' tracks they are larger. Two gates may
stand next to each other."""
CLEAR_WAY = 0.5
"""Horizontal size of the unit vector to a gate, or of the mean of those to and from it, below which
the path has no direction there: it is steep, or turns back."""
CLOSED = 1.5
"""A path is closed if its ends are nearer than this multiple of its longest step."""
ALONG, ALONG_OTHERWISE, AMISS = 0.7, 0.85, 0.55
"""Mean cosine of the gates' directions with the ways through them: the smallest usual one, one that
another reading of the yaws must reach, and one that is a mistake without another reading. On the
families' tracks it is 0.78 or more."""
AWAY, TOWARDS = 0.7, 0.9
"""Cosines of the start's heading with the way to gate 0: surely away, and surely towards it."""


def track_notes(name: str, track: Track) -> list[str]:
    """Return notes, as sentences, on what is probably a mistake in the track `name`."""
    gates, notes = track.scene.gates, []
    center_w, ahead_w = gates.center_w, gates.rot_w[:, :, 0]
    opening_m = float(np.ptp(gates.opening_g, axis=1).max())
    frame_m = float(max(gates.frame_width.max(), gates.frame_depth.max()))
    way_w = np.diff(np.vstack([track.start_pos_w, center_w]), axis=0)  # to each gate
    length_m = np.linalg.norm(way_w, axis=1)
    step_m = float(length_m.max())
    if opening_m > OPENING_MOST_M or frame_m > FRAME_MOST_M or step_m > STEP_MOST_M:
        notes.append(
            f"its largest gate is {opening_m:g} m wide, with a frame of up to {frame_m:g} m, and "
            f"start and gates are up to {step_m:g} m apart; is the file in centimetres or "
            "millimetres? Lengths are in metres"
        )
    yaw = np.arctan2(ahead_w[:, 1], ahead_w[:, 0])
    yaw_deg = np.rad2deg(yaw)
    written = _in_radians(yaw_deg) & (np.abs(yaw_deg).max() < 2.0 * np.pi + ROUNDING)
    if written.any():
        gate = int(np.argmax(written))
        notes.append(f"gate {gate} has a yaw of {yaw_deg[gate]:.4g} deg; is yaw_deg in radians?")
    way_w = way_w / np.maximum(length_m, 1e-9)[:, None]
    start_deg = np.rad2deg(track.start_yaw)
    # The cosines for the yaw as read, and for radians that were written as degrees.
    heading = [
        np.array([np.cos(yaw), np.sin(yaw)]) @ way_w[0, :2] for yaw in (track.start_yaw, start_deg)
    ]
    if _in_radians(start_deg) and heading[0] < AWAY and heading[1] > TOWARDS:
        notes.append(f"the start has a yaw of {start_deg:.4g} deg; is start.yaw_deg in radians?")
    elif heading[0] < AGAINST:
        notes.append("the start faces away from gate 0; turn start.yaw_deg by 180 deg?")
    for gate in np.flatnonzero((length_m[1:] > 1e-3) & (length_m[1:] < STEP_LEAST_M))[:1]:
        apart_m = length_m[gate + 1]
        notes.append(f"gates {gate} and {gate + 1} are only {apart_m:.2g} m apart; in metres?")
    turned = _turned(track, way_w, yaw)
    if way_w[0] @ ahead_w[0] < AGAINST and not any(gate == 0 for gate, _ in turned):
        notes.append("the start is behind gate 0, on the side where the drone leaves it")
    if not written.any():
        notes += _misdirected(way_w, yaw, turned)
    # A gate may be listed again, for another lap, but not next to itself.
    step_w, turn = np.diff(center_w, axis=0), (ahead_w[1:] * ahead_w[:-1]).sum(axis=1)
    for gate in np.flatnonzero((np.linalg.norm(step_w, axis=1) < 1e-3) & (turn > 0.999))[:1]:
        notes.append(f"gates {gate} and {gate + 1} have the same place and direction")
    return [f"{name}: {note}" for note in [*notes, *_misplaced(track)]]


def _turned(track: Track, way_w: np.ndarray, yaw: np.ndarray) -> list[tuple[int, float]]:
    """Return the gates that are not along the path, with the cosine of their yaw with it.

    The arguments are those of `_misdirected`. At an end, the path has the direction of the only way
    there, or of a curve that continues the last turn, or leads to the other end of a closed path. A
    start that the file leaves out is placed by gate 0, so that gate 0 is an end then.
    """
    gates, count = track.scene.gates, len(yaw)
    if count < 2:
        return []
    step_w = np.diff(gates.center_w, axis=0, append=gates.center_w[:1])
    length_m = np.linalg.norm(step_w, axis=1)
    is_closed = count > 3 and length_m[-1] < CLOSED * length_m[:-1].max()
    ways = np.vstack([way_w, step_w[-1:] / max(length_m[-1], 1e-9)])[:, :2]
    angle, through = np.arctan2(ways[:, 1], ways[:, 0]), (ways[:-1] + ways[1:]) / 2.0
    is_clear = np.linalg.norm(through, axis=1) > CLEAR_WAY
    cosine = np.where(is_clear, np.cos(yaw - np.arctan2(through[:, 1], through[:, 0])), 1.0)
    limit = np.full(count, ACROSS if count > 2 else AGAINST)

    def at_end(gate: int, way: int, inner: int, closing_w: np.ndarray) -> None:
        turn = np.angle(np.exp(1j * (angle[way] - angle[inner])))
        paths = [angle[way], angle[way] + turn / 2.0]
        if is_closed:
            paths.append(float(np.arctan2(closing_w[1], closing_w[0])))
        clear = np.linalg.norm(ways[way]), np.linalg.norm(closing_w) if is_closed else 1.0
        cosine[gate] = np.cos(yaw[gate] - np.array(paths)).max() if min(clear) > CLEAR_WAY else 1.0
        limit[gate] = min(limit[gate], ACROSS_AT_END)

    at_end(count - 1, count - 1, count - 2, through[-1])
    ahead_w = gates.rot_w[:, :, 0] * [1.0, 1.0, 0.0]
    behind_w = START_BEHIND_M * ahead_w[0] / max(np.linalg.norm(ahead_w[0]), 1e-9)
    if np.allclose(track.start_pos_w, gates.center_w[0] - behind_w):
        at_end(0, 1, min(2, count - 1), (ways[-1] + ways[1]) / 2.0)
    is_level = np.linalg.norm(ahead_w, axis=1) > CLEAR_WAY
    return [(int(gate), cosine[gate]) for gate in np.flatnonzero(is_level & (cosine < limit))]


def _misdirected(way_w: np.ndarray, yaw: np.ndarray, turned: list[tuple[int, float]]) -> list[str]:
    """Return a note if the gates' directions are not along the path, or one is turned.

    `way_w` (N, 3) are unit vectors to each gate, and `yaw` (N,) the gates' yaws [rad]. The way
    through a gate is the mean of the horizontal ways to and from it; turns back have none.
    """
    notes = [
        f"gate {gate} faces "
        + (
            "against the path; turn its yaw by 180 deg?"
            if cosine < AGAINST
            else "across the path; check its yaw_deg, the direction of flight"
        )
        for gate, cosine in turned[:1]
    ]
    through_w = (way_w + np.vstack([way_w[1:], way_w[-1:]]))[:, :2] / 2.0
    size = np.linalg.norm(through_w, axis=1)
    clear = size > 0.05
    if clear.sum() < 3:
        return notes
    way = np.arctan2(through_w[clear, 1], through_w[clear, 0])

    def along(read: np.ndarray) -> float:
        return float(np.cos(read[clear] - way).mean())

    if (found := along(yaw)) >= ALONG:
        return notes
    otherwise = {
        "with all yaws turned by 90 deg": along(yaw + np.pi / 2.0),
        "with all yaws turned by -90 deg": along(yaw - np.pi / 2.0),
        "with the opposite sign of all yaws": along(-yaw),
        "with yaws in radians": along(np.rad2deg(yaw)),
    }
    best = max(otherwise, key=lambda name: otherwise[name])
    text = f"the gates' directions are not along the path: their mean cosine is {found:.2f}"
    if otherwise[best] >= ALONG_OTHERWISE:
        return [f"{text}, {best} {otherwise[best]:.2f}; yaw_deg is the direction of flight"]
    order = [f"{text}; check the order of the gates and each yaw_deg"] if found < AMISS else []
    return notes or order


def _in_radians(yaw_deg: np.ndarray | float) -> np.ndarray:
    """Return which yaws [deg], but for 0, are a multiple of 45 deg if they were radians."""
    quarters = np.round(np.divide(yaw_deg, QUARTER_DEG))
    return (quarters != 0) & (np.abs(yaw_deg - quarters * QUARTER_DEG) < ROUNDING)


def _misplaced(track: Track) -> list[str]:
    """Return notes on a solid in front of or in a gate, and on too large and too distant ones."""
    # Imported here, because trimesh takes long to import and only custom tracks need it.
    from tracks.formats.meshes import solid_meshes

    gates, notes = track.scene.gates, {}
    course_w = np.vstack([track.start_pos_w, gates.center_w])
    points_w = _opening_points(gates)
    through_w = np.broadcast_to(gates.rot_w[:, None, :, 0], points_w.shape).reshape(-1, 3)
    for name, mesh in solid_meshes(track):
        corners_w = np.asarray(mesh.vertices)
        thick_m = float(np.ptp(corners_w, axis=0).min())
        # Distance of the boxes around the solid and around the course.
        gap_w = np.maximum(corners_w.min(0) - course_w.max(0), course_w.min(0) - corners_w.max(0))
        far_m = float(np.linalg.norm(np.maximum(gap_w, 0.0)))
        for gate in np.flatnonzero(_on_the_way(mesh, gates.center_w, gates.rot_w[:, :, 0])):
            said = (
                f"{name!r} is within {CLEAR_M:g} m in front of or behind the centre of gate {gate}"
            )
            notes.setdefault("blocked", said)
        if name.startswith("gate "):
            meets = _on_the_way(mesh, points_w.reshape(-1, 3), through_w, INSIDE_M)
            for gate in np.flatnonzero(meets.reshape(points_w.shape[:2]).any(axis=1)):
                notes.setdefault("blocked", f"{name!r} stands in the opening of gate {gate}")
        if thick_m > THICK_MOST_M:
            said = f"{name!r} is {thick_m:.3g} m or more in all directions; is its file in metres?"
            notes.setdefault("large", said)
        if far_m > STEP_MOST_M:
            notes.setdefault("far", f"{name!r} is {far_m:.3g} m away from all gates and the start")
    return list(notes.values())


def _opening_points(gates: Gates) -> np.ndarray:
    """Return points (N, M, 3) in the openings of the gates, in the world frame."""
    share = np.linspace(0.0, 1.0, 4, endpoint=False)[:, None, None, None]
    edge_g = (1.0 - share) * gates.opening_g + share * np.roll(gates.opening_g, -1, axis=1)
    inward = np.linspace(0.0, IN_OPENING, 20)[:, None, None, None, None]
    flat_g = np.moveaxis(inward * edge_g, 2, 0).reshape(len(gates.center_w), -1, 2)
    return gates.center_w[:, None] + flat_g @ np.swapaxes(gates.rot_w[:, :, 1:], 1, 2)


def _on_the_way(
    mesh: trimesh.Trimesh, center_w: np.ndarray, ahead_w: np.ndarray, reach_m: float = CLEAR_M
) -> np.ndarray:
    """Return which axes (N,) meet a convex mesh within `reach_m` of their centre."""
    point_w, normal_w = np.asarray(mesh.triangles)[:, 0], np.asarray(mesh.face_normals)
    # The faces' normals point inwards or outwards, depending on the file.
    inside = ((np.asarray(mesh.vertices).mean(0) - point_w) * normal_w).sum(-1)
    normal_w = normal_w * np.where(inside > 0.0, -1.0, 1.0)[:, None]
    # A part of an axis is inside where it is below all faces: above + slope * distance < 0.
    above = (center_w[:, None] * normal_w).sum(-1) - (point_w * normal_w).sum(-1)
    slope = ahead_w @ normal_w.T
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing_m = -above / slope
    first_m = np.where(slope < 0.0, crossing_m, -reach_m).max(axis=1, initial=-reach_m)
    last_m = np.where(slope > 0.0, crossing_m, reach_m).min(axis=1, initial=reach_m)
    return (first_m < last_m) & ~((slope == 0.0) & (above >= 0.0)).any(axis=1)

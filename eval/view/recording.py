"""Write trials, flights along a track, as recordings for the rerun 3D viewer.

A recording is made from flight logs, which hold the data. Only this file, `blueprint.py` and
`comparison.py` use rerun, whose interface changes every few releases (0.41 here). Columns of a
whole flight are sent at once, which is much faster than row by row.

Entities of trial k are below `/trial_k`: `world/ground`, `world/obstacles/NAME`, `world/gates/N`,
`world/path`, `world/start`, `world/end`, `world/drone` (moving, with `body`, `rotors` and
`camera/depth`), and the series `speed`, `thrust`, `rates`, `action`, `rotors` and `events`, all on
the timeline `time` in seconds from the trial's start.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from eval.logs.flight import Flight
from eval.view import colours
from eval.view.blueprint import TIMELINE, Tab, tabs_blueprint, trial_view
from eval.view.solids import (
    DRONE_HALF_SIZE,
    ROTOR_RADIUS_M,
    flat_normals,
    join_solids,
    track_solids,
)
from eval.worlds.trial import TrialResult
from policies.spec import ACTIONS
from tracks.common.files import replacing_file
from tracks.common.provenance import stamp
from tracks.geometry.camera import Camera, optical_axis_b
from tracks.track import Track

APPLICATION = "diffracing-suite"
"""Name of the application in the rerun viewer."""
SCHEMA = 1
"""Version of the recording's entities, which is stored in its properties."""
GROUND = (226, 228, 224)
"""Colour of the ground, 0-255."""
GROUND_MARGIN_M = 3.0
"""Distance by which the ground extends beyond track and flight [m]."""
BEFORE_GATE_S = 0.6
"""Time before the first gate at which the playback starts [s]."""
ROTORS_B = ((0.075, -0.10, 0.03), (-0.075, -0.10, 0.03), (-0.075, 0.10, 0.03), (0.075, 0.10, 0.03))
"""Default positions of the drawn rotors, body axes [m]."""

Rollout = tuple[Track, Flight, TrialResult]
"""Track, flight and outcome of a trial."""


class Drone(NamedTuple):
    """The drone's shape and camera in a recording."""

    half_size: tuple[float, float, float] = DRONE_HALF_SIZE
    """Half extents of the body's box [m]."""
    rotors_b: tuple[tuple[float, float, float], ...] = ROTORS_B
    """Positions of the rotors in body axes [m]."""
    camera: Camera = Camera()
    """The camera that recorded the flight's depth images."""


def write_recording(
    path: str | Path, rollouts: Sequence[Rollout], drone: Drone | None = None
) -> Path:
    """Write trials as a rerun recording (.rrd) with a layout; needs no viewer and no network.

    Each trial gets a tab. Without a drone, shape and camera are the defaults of `Drone`.

    Raises:
        ValueError: where `rollouts` is empty.
        OSError: where the file cannot be written; nothing is left under its name.
    """
    if not rollouts:
        raise ValueError("a recording needs at least one rollout; got none")
    drone = drone or Drone()
    with_policy = len({result.policy for _, _, result in rollouts}) > 1
    tabs = [_tab(k, *rollout, with_policy) for k, rollout in enumerate(rollouts)]
    blueprint = tabs_blueprint(list(map(trial_view, tabs)), _playback_span(rollouts))
    with open_recording(path, blueprint, stamp(SCHEMA, rollouts[0][2].seed)) as recording:
        for tab, (track, flight, result) in zip(tabs, rollouts, strict=True):
            world = f"{tab.root}/world"
            recording.log(world, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
            _log_track(recording, world, tab, track, flight)
            _log_marks(recording, world, track, result)
            if len(flight.time_s):  # a trial that ended at its first step has no rows
                _log_path(recording, world, flight)
                _log_drone(recording, f"{world}/drone", flight, drone)
                _log_series(recording, tab.root, flight)
            _log_events(recording, f"{tab.root}/events", flight, result)
    return Path(path)


@contextmanager
def open_recording(
    path: str | Path, blueprint: rrb.Blueprint, origin: Mapping[str, Any]
) -> Iterator[rr.RecordingStream]:
    """Yield a recording that becomes the file `path`, with its layout and its provenance."""
    # Nothing is sent before `save`, so that the blueprint comes first in the file.
    recording = rr.RecordingStream(APPLICATION)
    with replacing_file(path) as temporary:
        recording.save(temporary, default_blueprint=blueprint)
        try:
            texts = {key: str(value) for key, value in origin.items() if value is not None}
            recording.send_property("suite", rr.AnyValues(drop_untyped_nones=True, **texts))
            yield recording
            try:
                recording.flush()
            except RuntimeError as error:  # of rerun's writing thread, which drops the cause
                text = f"cannot be written ({error}), the disk may be full"
                raise OSError(errno.EIO, text, str(path)) from error
        finally:
            recording.disconnect()


def _tab(number: int, track: Track, flight: Flight, result: TrialResult, with_policy: bool) -> Tab:
    """Return the layout's inputs for trial `number`; `with_policy` puts the policy in the title."""
    vertices = [solid.vertices for solid in track_solids(track)]
    finite_pos_w = flight.pos_w[np.isfinite(flight.pos_w).all(axis=1)]
    points = np.concatenate([*vertices, track.start_pos_w[None], finite_pos_w])
    title = f"{track.family} level {track.level} seed {track.seed}: {result.ended_by}"
    if with_policy:
        title = f"{result.policy}, {title}"
    low_w, high_w = points.min(axis=0), points.max(axis=0)
    return Tab(f"/trial_{number}", title, _has_depth(flight), low_w, high_w, flight.action_kind)


def _playback_span(rollouts: Sequence[Rollout]) -> tuple[float, float]:
    """Return the played span [s], from just before the first trial's first gate to the last end."""
    flight = rollouts[0][1]
    passed = flight.time_s[flight.gate > 0]
    begin = max(0.0, float(passed[0]) - BEFORE_GATE_S) if len(passed) else 0.0
    return begin, max(result.time_s for _, _, result in rollouts)


def _has_depth(flight: Flight) -> bool:
    return flight.depth_m is not None and len(flight.depth_m) > 0


def time_columns(time_s: np.ndarray) -> list[rr.TimeColumn]:
    """Return `time_s` (T,) [s] as rerun's column of the recording's timeline."""
    # The file stores whole nanoseconds, and rerun would round down.
    return [rr.TimeColumn(TIMELINE, duration=np.round(time_s * 1e9).astype("timedelta64[ns]"))]


def _mesh(
    vertices: np.ndarray, faces: np.ndarray, colour: tuple[int, int, int] | None
) -> rr.Mesh3D:
    """Return a flat-shaded mesh: every triangle has its own corners and brightness."""
    corners = vertices[faces]
    grey = np.round(255 * colours.brightness(flat_normals(corners))).astype(np.uint8)
    return rr.Mesh3D(
        vertex_positions=corners.reshape(-1, 3),
        triangle_indices=np.arange(len(faces) * 3).reshape(-1, 3),
        # The brightness is in the vertices, as the viewer's light makes shaded gates black.
        vertex_colors=np.repeat(grey, 3)[:, None].repeat(3, axis=1),
        albedo_factor=colour,
    )


def _log_track(
    recording: rr.RecordingStream, world: str, tab: Tab, track: Track, flight: Flight
) -> None:
    """Log the ground, the obstacles, and the gates, whose colour changes when they are passed."""
    low, high = tab.low_w - GROUND_MARGIN_M, tab.high_w + GROUND_MARGIN_M
    edge = np.array([[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]])
    ground = _mesh(np.insert(edge, 2, 0.0, 1), np.array([[0, 1, 2], [0, 2, 3]]), GROUND)
    recording.log(f"{world}/ground", ground, static=True)
    solids = track_solids(track)
    for number in range(len(track.scene.gates.center_w)):
        entity = f"{world}/gates/{number}"
        frame = join_solids([solid for solid in solids if solid.gate == number])
        recording.log(entity, _mesh(*frame, None), static=True)
        passed = np.flatnonzero(flight.gate > number)
        time = np.array([0.0, *flight.time_s[passed[:1]]])
        colour = [colours.AHEAD, colours.PASSED][: len(time)]
        recording.send_columns(entity, time_columns(time), rr.Mesh3D.columns(albedo_factor=colour))
    for solid in solids:
        if solid.gate is None:
            entity = f"{world}/obstacles/{rr.escape_entity_path_part(solid.name)}"
            mesh = _mesh(solid.vertices, solid.faces, colours.SOLID)
            recording.log(entity, mesh, static=True)


def _log_path(recording: rr.RecordingStream, world: str, flight: Flight) -> None:
    """Log the flight's path, coloured by speed."""
    speed = np.linalg.norm(flight.vel_w, axis=1)
    segments = np.stack([flight.pos_w[:-1], flight.pos_w[1:]], axis=1)
    finite = np.isfinite(segments).all(axis=(1, 2)) & np.isfinite(speed[:-1])
    colour = colours.speed_colours(speed[:-1], colours.top_speed(speed))
    path = rr.LineStrips3D(segments[finite], colors=colour[finite], radii=0.025)
    recording.log(f"{world}/path", path, static=True)


def _log_marks(
    recording: rr.RecordingStream, world: str, track: Track, result: TrialResult
) -> None:
    """Log points at the start and the end of the flight."""
    start = rr.Points3D([track.start_pos_w], radii=0.08, colors=[colours.START], labels=["start"])
    recording.log(f"{world}/start", start, static=True)
    colour = colours.PASSED if result.ended_by == "finished" else colours.CRASH
    end = [[result.pos_x, result.pos_y, result.pos_z]]
    mark = rr.Points3D(end, radii=0.12, colors=[colour], labels=[result.ending])
    recording.log(f"{world}/end", mark, static=True)


def _log_drone(recording: rr.RecordingStream, entity: str, flight: Flight, drone: Drone) -> None:
    """Log the moving drone: body, rotors, and the camera with its depth images."""
    columns = rr.Transform3D.columns(
        translation=flight.pos_w, quaternion=np.roll(flight.quat_wxyz, -1, axis=1)
    )
    recording.send_columns(entity, time_columns(flight.time_s), columns)
    body = rr.Boxes3D(half_sizes=[drone.half_size], colors=[colours.DRONE], fill_mode="solid")
    recording.log(f"{entity}/body", body, static=True)
    rotors = np.array(drone.rotors_b)
    discs = rr.Ellipsoids3D(
        centers=rotors,
        half_sizes=np.tile([ROTOR_RADIUS_M, ROTOR_RADIUS_M, 0.006], (len(rotors), 1)),
        # The colour marks the two front rotors.
        colors=[colours.AHEAD if x > 0 else colours.SOLID_EDGE for x in rotors[:, 0]],
        fill_mode="solid",
    )
    recording.log(f"{entity}/rotors", discs, static=True)
    # A drone of 20 cm is too small on a track of 35 m; a dot of constant size on screen marks it.
    pin = rr.Points3D([[0.0, 0.0, 0.0]], radii=rr.Radius.ui_points(4), colors=[colours.CRASH])
    recording.log(f"{entity}/pin", pin, static=True)
    if not _has_depth(flight):
        return
    camera = drone.camera
    forward = optical_axis_b(camera)
    right = np.array([0.0, -1.0, 0.0])
    camera_to_body = np.stack([right, np.cross(forward, right), forward], axis=1)
    half_size = np.array([camera.width, camera.height]) / 2
    focal_px = half_size / np.tan(np.deg2rad(np.array(camera.fov_deg)) / 2)
    eye = f"{entity}/camera"
    recording.log(eye, rr.Transform3D(mat3x3=camera_to_body), static=True)
    pinhole = rr.Pinhole(
        focal_length=focal_px,
        width=camera.width,
        height=camera.height,
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.4,
    )
    recording.log(eye, pinhole, static=True)
    _log_depth(recording, f"{eye}/depth", flight, camera)


def _log_depth(recording: rr.RecordingStream, entity: str, flight: Flight, camera: Camera) -> None:
    """Log the depth images at the policy's decisions."""
    frames = np.ascontiguousarray(flight.depth_m, dtype=np.float32)
    constant = rr.DepthImage.from_fields(
        format=rr.components.ImageFormat(
            width=frames.shape[2], height=frames.shape[1], channel_datatype="F32"
        ),
        meter=1.0,
        depth_range=[0.0, camera.range_m],
        colormap="turbo",
        # Pixels are drawn as small 3D points, so that they do not hide the track behind them.
        point_fill_ratio=0.2,
    )
    recording.log(entity, constant, static=True)
    times = time_columns(np.asarray(flight.depth_time_s))
    buffers = frames.view(np.uint8).reshape(len(frames), -1)
    recording.send_columns(entity, times, rr.DepthImage.columns(buffer=buffers))


def _log_series(recording: rr.RecordingStream, root: str, flight: Flight) -> None:
    """Log speed, commands, body rates, actions and rotor speeds as curves."""
    policy_steps = np.asarray(flight.policy_step, dtype=bool)
    axes = list(colours.AXES)
    pale_axes = [tuple(int(part * 0.5 + 127) for part in colour) for colour in axes]
    grey, actions = [colours.SOLID_EDGE], list(ACTIONS[flight.action_kind])
    speed = np.linalg.norm(flight.vel_w, axis=1)
    all_rows = slice(None)
    series = [
        ("speed", speed[:, None], all_rows, ["|vel_w|"], [colours.AHEAD]),
        ("thrust/command", flight.thrust_cmd[:, None], all_rows, ["c"], [colours.CRASH]),
        ("rates/measured", flight.rate_b, all_rows, ["x", "y", "z"], axes),
        ("rates/command", flight.rate_cmd_b, all_rows, ["x cmd", "y cmd", "z cmd"], pale_axes),
        ("action", flight.action_b, policy_steps, actions, [*axes, *grey][: len(actions)]),
        ("rotors", flight.rotor_speed, all_rows, ["1", "2", "3", "4"], [*axes, *grey]),
    ]
    for name, values, rows, names, colour in series:
        style = rr.SeriesLines(names=names, colors=colour)
        log_curves(recording, f"{root}/{name}", flight.time_s[rows], values[rows], style)


def log_curves(
    recording: rr.RecordingStream,
    entity: str,
    time_s: np.ndarray,
    values: np.ndarray,
    style: rr.SeriesLines,
) -> None:
    """Log a curve (T,) or several (T, n) at the times `time_s` (T,) [s]."""
    recording.log(entity, style, static=True)
    columns = rr.Scalars.columns(scalars=np.asarray(values, dtype=np.float64))
    recording.send_columns(entity, time_columns(time_s), columns)


def _log_events(
    recording: rr.RecordingStream, entity: str, flight: Flight, result: TrialResult
) -> None:
    """Log the passages of gates and the end as text."""
    rows = np.flatnonzero(np.diff(flight.gate)) + 1
    texts = [f"gate {flight.gate[row] - 1} passed" for row in rows]
    texts.append(result.ending)
    time = np.append(flight.time_s[rows], result.time_s)
    recording.send_columns(entity, time_columns(time), rr.TextLog.columns(text=texts))

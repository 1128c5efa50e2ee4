"""Write a video of a trial from behind the drone, next to the policy's depth image.

`scene3d.py` draws the frames and `video_file.py` encodes them, so neither a display nor a GPU is
needed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter1d

from eval.logs.flight import Flight
from eval.view import colours
from eval.view.chase import ABOVE_M, Drone, camera_behind, draw_drone, scenery_of
from eval.view.scene3d import SKY, Lines
from eval.view.video_file import ENCODING, write_video_file
from eval.worlds.trial import TrialResult
from tracks.common.files import replacing_file
from tracks.geometry.rotation import quat_to_rot
from tracks.track import Track

DEPTH_RANGE_M = 10.0
"""Depth at the end of the colour scale [m]."""
TRAIL_S = 1.6
"""Duration of the path shown behind the drone [s]."""
SIDE_SHARE = 1 / 3
"""Width of the depth image divided by the width of a frame, for flights with depth images."""
HEADING_SMOOTHING_S, POSITION_SMOOTHING_S = 0.25, 0.06
"""Standard deviations of the Gaussian filters of the camera's direction and position [s]."""


@dataclass(frozen=True)
class VideoOptions:
    """Size and rate of a video."""

    size: tuple[int, int] = (960, 540)
    """Width and height, even numbers [pixels]."""
    fps: int = 30
    """Frames per second of the video."""
    hold_s: float = 1.0
    """Duration of the last frame [s]."""


SMALL = VideoOptions(size=(720, 360), fps=12)
"""Options for web pages: a GIF of a race has less than about 3 MB."""


def frame_times(flight: Flight, options: VideoOptions) -> np.ndarray:
    """Return the time in the flight of each frame (F,) [s]; the last frame is repeated."""
    end = float(flight.time_s[-1])
    times = np.arange(float(flight.time_s[0]), end, 1 / options.fps)
    return np.concatenate([times, np.full(max(1, round(options.hold_s * options.fps)), end)])


def write_video(
    path: str | Path,
    track: Track,
    flight: Flight,
    result: TrialResult,
    options: VideoOptions | None = None,
    on_frame: Callable[[int], None] | None = None,
) -> Path:
    """Write a video of a trial as MP4 (H.264) or GIF, by the ending of `path`.

    The log may lack depth images. `on_frame` is called after each frame with the number of finished
    frames, of `len(frame_times(...))` in all.

    Raises:
        ValueError: for another ending, an odd size, or a flight with fewer than two rows.
        OSError: where the file cannot be written; nothing is left under its name.
    """
    path, options = Path(path), options or VideoOptions()
    if path.suffix.lower() not in ENCODING:
        raise ValueError(f"{path}: ending {path.suffix!r}; a video ends in .mp4 or .gif")
    if options.size[0] % 2 or options.size[1] % 2 or min(options.size) < 64:
        raise ValueError(f"size {options.size}; both must be even and 64 or more")
    flight = _finite_part(flight)
    if len(flight.time_s) < 2:
        raise ValueError(f"{path}: a flight of {len(flight.time_s)} usable rows; two are needed")
    frames = video_frames(track, flight, result, options)
    with replacing_file(path) as temporary:
        write_video_file(temporary, frames, options.size, options.fps, on_frame)
    return path


def video_frames(
    track: Track, flight: Flight, result: TrialResult, options: VideoOptions
) -> Iterator[Image.Image]:
    """Yield the frames of a video, one for each of `frame_times`."""
    scenery = scenery_of(track)
    times = frame_times(flight, options)
    speed = np.linalg.norm(flight.vel_w, axis=1)
    top = colours.top_speed(speed)
    segments_w = np.stack([flight.pos_w[:-1], flight.pos_w[1:]], axis=1)
    path_colour = colours.speed_colours(speed[:-1], top)
    rot_w = quat_to_rot(flight.quat_wxyz)
    eye_w, target_w = _chase_camera(flight, rot_w)
    images = flight.depth_m if flight.depth_m is not None and len(flight.depth_m) else None
    image_s = np.asarray(flight.depth_time_s)
    side_width = 0 if images is None else round(options.size[0] * SIDE_SHARE)
    size = options.size[0] - side_width, options.size[1]
    for time in times:
        row = int(np.searchsorted(flight.time_s, time, side="right")) - 1
        pos, eye, target = (
            np.array([np.interp(time, flight.time_s, column) for column in values.T])
            for values in (flight.pos_w, eye_w, target_w)
        )
        passed = int(flight.gate[row])
        trail = (flight.time_s[:-1] > time - TRAIL_S) & (flight.time_s[1:] <= time)
        lines = Lines(segments_w[trail], path_colour[trail], 0.03)
        drone = Drone(pos, rot_w[row], passed)
        frame = Image.new("RGB", options.size, SKY)
        frame.paste(draw_drone(scenery, drone, (eye, target), size, lines))
        if images is not None:
            number = int(np.searchsorted(image_s, time, side="right")) - 1
            _draw_depth(frame, side_width, images[min(max(number, 0), len(images) - 1)])
        ended = time >= flight.time_s[-1]
        _draw_text(frame, side_width, track, result, float(time), float(speed[row]), passed, ended)
        yield frame


def _finite_part(flight: Flight) -> Flight:
    """Return the flight up to the first row that is not finite, where the simulation diverged."""
    state = np.concatenate([flight.pos_w, flight.quat_wxyz, flight.vel_w], axis=1)
    not_finite = np.flatnonzero(~np.isfinite(state).all(axis=1))
    if not len(not_finite):
        return flight
    rows = {name: getattr(flight, name) for name in Flight._fields[:-2]}
    finite = {name: each[: not_finite[0]] for name, each in rows.items() if each is not None}
    return flight._replace(**finite)


def _chase_camera(flight: Flight, rot_w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the camera's position and target for every row, (T, 3) each [m]."""
    step_s = max(float(np.median(np.diff(flight.time_s))), 1e-6)

    def smooth(values: np.ndarray, sd_s: float) -> np.ndarray:
        return gaussian_filter1d(np.nan_to_num(values), sd_s / step_s, axis=0, mode="nearest")

    # The heading is added, so that the direction is defined for a drone at rest too.
    direction = smooth(flight.vel_w[:, :2] + 0.5 * rot_w[:, :2, 0], HEADING_SMOOTHING_S)
    eye_w, target_w = camera_behind(smooth(flight.pos_w, POSITION_SMOOTHING_S), direction)
    return eye_w, target_w + [0.0, 0.0, 0.15 * ABOVE_M]


def _draw_depth(frame: Image.Image, width: int, depth_m: np.ndarray) -> None:
    """Draw the policy's depth image at the right, with its label and the scale of its colours."""
    size = (width, max(1, width * depth_m.shape[0] // depth_m.shape[1]))
    depth_picture = Image.fromarray(colours.depth_colours(depth_m, DEPTH_RANGE_M))
    corner = (frame.width - width, (frame.height - size[1]) // 2)
    frame.paste(depth_picture.resize(size, Image.Resampling.NEAREST), corner)
    draw = ImageDraw.Draw(frame)
    font = ImageFont.load_default(size=_font_size(frame))
    draw.line([corner[0] - 1, 0, corner[0] - 1, frame.height], fill=colours.DRONE)
    text = f"depth image, {depth_m.shape[1]} x {depth_m.shape[0]}, to {DEPTH_RANGE_M:g} m"
    middle = corner[0] + width / 2
    draw.text((middle, corner[1] - 6), text, fill=colours.DRONE, font=font, anchor="mb")
    left, top, scale_width = int(corner[0] + 0.1 * width), corner[1] + size[1] + 8, int(0.8 * width)
    scale = colours.depth_colours(np.linspace(0.0, DEPTH_RANGE_M, scale_width)[None], DEPTH_RANGE_M)
    scale_height = max(4, frame.height // 60)
    frame.paste(
        Image.fromarray(scale).resize((scale_width, scale_height), Image.Resampling.NEAREST),
        (left, top),
    )
    for share in (0.0, 0.5, 1.0):
        label_at = (left + share * scale_width, top + scale_height + 3)
        label = f"{share * DEPTH_RANGE_M:g}" + (" m" if share == 1.0 else "")
        draw.text(label_at, label, fill=colours.DRONE, font=font, anchor="mt")


def _font_size(frame: Image.Image) -> int:
    return max(frame.height // 27, 11)


def _draw_text(
    image: Image.Image,
    side_width: int,
    track: Track,
    result: TrialResult,
    time: float,
    speed: float,
    passed: int,
    ended: bool,
) -> None:
    """Draw the track's name, the state of the flight, and in the last frame its outcome."""
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(size=_font_size(image))
    gates = len(track.scene.gates.center_w)
    title = f"{track.family}  level {track.level}  seed {track.seed}"
    # A pale edge keeps the text readable on a dark gate.
    edge: dict[str, Any] = {"stroke_width": max(1, image.height // 270), "stroke_fill": SKY}
    draw.text((14, 10), title, fill=colours.DRONE, font=font, **edge)
    status = f"{time:5.2f} s    {speed:4.1f} m/s    gates {passed}/{gates}"
    draw.text((14, image.height * 0.93), status, fill=colours.DRONE, font=font, **edge)
    if ended:
        colour = colours.PASSED if result.ended_by == "finished" else colours.CRASH
        large = ImageFont.load_default(size=image.height // 14)
        position = ((image.width - side_width) / 2, image.height * 0.2)
        draw.text(position, result.ending, fill=colour, font=large, anchor="mm", **edge)

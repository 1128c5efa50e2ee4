"""Draw pictures of trials as PNG, PDF or SVG, without a display."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text

from eval.logs.flight import Flight
from eval.view import colours
from eval.view.colours import SPEED_MAP, hex_text
from eval.view.solids import outline, track_solids
from eval.worlds.trial import TrialResult
from tracks.common.files import replacing_file
from tracks.input.ranges import check_type
from tracks.track import Track

Shown = tuple[Track, Flight | None, TrialResult | None]
"""A track, with an optional flight and its outcome."""

TOP, SIDE = (0, 1), (0, 2)
"""World axes along the width and the height of a view, 0 for x."""
MARGIN_M = 1.0
"""Distance by which a picture extends beyond track and flight [m]."""
PATH_WIDTH = 2.2
"""Width of the flight's path [points]."""
PASSED, CRASH, START, GREY = map(
    hex_text, (colours.PASSED, colours.CRASH, colours.START, colours.SOLID_EDGE)
)
"""Colours as texts for matplotlib; see `eval.view.colours`."""


def write_picture(
    path: str | Path,
    track: Track,
    flight: Flight | None = None,
    result: TrialResult | None = None,
) -> Path:
    """Draw a trial, or a track without a flight, from above and from the side.

    The file's ending sets the format. The path is coloured by speed; title and mark at the end show
    the result. The picture is up to 9.5 inches wide and 9.2 high.

    Raises:
        ValueError: for an ending that is no format of a picture, or something else than a track.
        OSError: where the file cannot be written; nothing is left under its name.
    """
    check_type("track", track, (Track,), "a Track, as of make_track or load_track")
    low, high = _limits(track, flight)
    extent_x, extent_y, extent_z = high - low
    # Both views have the same scale [inch/m], so their heights follow from the track's extent.
    scale = min(7.6 / extent_x, 7.5 / (extent_y + extent_z))
    size = (max(extent_x * scale, 4.5) + 1.9, (extent_y + extent_z) * scale + 1.65)
    figure = Figure(figsize=size, layout="constrained")
    top, side = figure.subplots(2, 1, sharex=True, height_ratios=[extent_y, extent_z])
    speed = _speed_range([flight])
    for axes, view in ((top, TOP), (side, SIDE)):
        _draw(axes, (track, flight, result), view, speed)
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[view[1]], high[view[1]])
    top.set_ylabel("y [m]")
    side.set_ylabel("z [m]")
    side.set_xlabel("x [m]")
    side.axhline(0, color=GREY, linewidth=1.2, zorder=1)
    figure.suptitle(_title(track), fontsize=13, fontweight="bold", x=0.02, ha="left")
    if result is not None:
        top.set_title(_outcome(result), fontsize=10, loc="left", color="#444444")
    if flight is not None:
        _colour_bar(figure, [top, side], speed)
    _legend(figure, [(track, flight, result)])
    return _save(figure, path, dpi=130)


def write_grid(path: str | Path, trials: Sequence[Shown], columns: int = 3) -> Path:
    """Draw several trials from above, each in a panel, with one colour bar.

    The file's ending sets the format. `columns` panels are in a row.

    Raises:
        ValueError: where `trials` is empty, or for an ending that is no format of a picture.
        OSError: where the file cannot be written; nothing is left under its name.
    """
    if not trials:
        raise ValueError("a grid needs at least one trial; got none")
    columns = min(columns, len(trials))
    rows = math.ceil(len(trials) / columns)
    limits = [_limits(track, flight) for track, flight, _ in trials]
    # Row heights follow from the aspect ratios of their panels.
    ratio = np.array([(high - low)[1] / (high - low)[0] for low, high in limits])
    ratio = np.clip(ratio, 0.3, 1.1)
    row_ratios = [ratio[row * columns : (row + 1) * columns].max() for row in range(rows)]
    panel = 4.2  # width of a panel [inch]
    height = sum(panel * row_ratio + 0.85 for row_ratio in row_ratios) + 0.5
    figure = Figure(figsize=(panel * columns + 0.9, height), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, height_ratios=row_ratios)
    speed = _speed_range([flight for _, flight, _ in trials])
    for axes in grid.flat[len(trials) :]:
        axes.set_axis_off()
    for axes, shown, (low, high) in zip(grid.flat, trials, limits, strict=False):
        track, _, result = shown
        _draw(axes, shown, TOP, speed, small=True)
        axes.set_anchor("N")
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(low[1], high[1])
        axes.set_xlabel("x [m]", fontsize=8)
        axes.set_ylabel("y [m]", fontsize=8)
        axes.set_title(_title(track), fontsize=9, fontweight="bold", loc="left", pad=16)
        if result is not None:
            units = {"xycoords": "axes fraction", "textcoords": "offset points"}
            text = _outcome(result, short=True)
            axes.annotate(text, (0, 1), xytext=(0, 4), fontsize=8, color="#444444", **units)
    if any(flight is not None for _, flight, _ in trials):
        _colour_bar(figure, list(grid.flat), speed)
    _legend(figure, trials)
    return _save(figure, path, dpi=110)


def _draw(
    axes: Axes, shown: Shown, view: tuple[int, int], speed: Normalize, small: bool = False
) -> None:
    """Draw the gates, obstacles, path, start and end of a trial in one view."""
    track, flight, result = shown
    if flight is not None and not len(flight.time_s):
        flight = None  # a trial that ended at its first step
    gates, passed = track.scene.gates, _passed(flight, result)
    solids = track_solids(track)
    obstacles = [solid.vertices for solid in solids if solid.gate is None]
    # Solids nearer to the viewer are drawn later: the highest from above, lowest y from the side.
    obstacles.sort(key=lambda points: points[:, 2].max() if view == TOP else -points[:, 1].min())
    axes.add_collection(
        PolyCollection(
            [outline(points[:, view]) for points in obstacles],
            facecolor=hex_text(colours.SOLID),
            edgecolor=hex_text(colours.SOLID_EDGE),
            lw=0.6,
            alpha=0.75,
        )
    )
    gate_bars = [solid for solid in solids if solid.gate is not None]
    colour = [_gate_colour(bar.gate, passed) for bar in gate_bars]
    frames = [outline(bar.vertices[:, view]) for bar in gate_bars]
    axes.add_collection(
        PolyCollection(frames, facecolor=colour, edgecolor=colour, lw=0.8, zorder=3)
    )
    if view == TOP:
        for number, (center, rot) in enumerate(zip(gates.center_w, gates.rot_w, strict=True)):
            colour = _gate_colour(number, passed)
            _draw_gate_number(axes, number, center[:2], rot[:2, 0], colour, small)
    if flight is not None:
        _draw_path(axes, flight, view, speed, small)
    start = track.start_pos_w[list(view)]
    size = 34 if small else 60
    axes.scatter(*start, s=size, marker="o", color="white", edgecolor=START, lw=1.8, zorder=6)
    if result is not None:
        end = np.array([result.pos_x, result.pos_y, result.pos_z])[list(view)]
        _mark_end(axes, end, result.ended_by, size)
    axes.set_aspect("equal")
    axes.grid(color="#e6e8ec", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=7 if small else 9)
    axes.spines[["top", "right"]].set_visible(False)


def _passed(flight: Flight | None, result: TrialResult | None) -> int:
    """Return the number of passed gates."""
    if result is not None:
        return result.gates_passed
    return 0 if flight is None or not len(flight.time_s) else int(flight.gate.max())


def _gate_colour(number: int | None, passed: int) -> str:
    ahead = number is None or number >= passed
    return hex_text(colours.AHEAD) if ahead else PASSED


def _draw_path(
    axes: Axes, flight: Flight, view: tuple[int, int], speed: Normalize, small: bool
) -> None:
    """Draw the flight's path, coloured by speed."""
    points = flight.pos_w[:, view]
    segments = np.stack([points[:-1], points[1:]], axis=1)
    speeds = np.linalg.norm(flight.vel_w, axis=1)[:-1]
    width = PATH_WIDTH * (0.75 if small else 1.0)
    path = LineCollection(list(segments), cmap=SPEED_MAP, norm=speed, lw=width, zorder=5)
    path.set_array(speeds)
    path.set_capstyle("round")
    axes.add_collection(path)


def _draw_gate_number(
    axes: Axes, number: int, center: np.ndarray, direction: np.ndarray, colour: str, small: bool
) -> None:
    """Draw a gate's number, from 0 as in `TrialResult.collided_with`, and its flight direction.

    `center` (2,) and `direction` (2,) are the gate's position and x axis, seen from above.
    """
    distance_pt = 13 if not small else 8
    direction = direction / max(float(np.linalg.norm(direction)), 1e-9)
    across = np.array([-direction[1], direction[0]])
    label = center + 0.75 * across
    axes.annotate(
        str(number),
        (label[0], label[1]),
        xytext=tuple(across * distance_pt * 0.6),
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=6.5 if small else 9,
        color=colour,
        fontweight="bold",
        zorder=7,
    )
    if not small:
        tip = (center[0] + 0.55 * direction[0], center[1] + 0.55 * direction[1])
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.0, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", tip, xytext=(center[0], center[1]), arrowprops=arrow, zorder=4)


def _mark_end(axes: Axes, end: np.ndarray, ended_by: str, size: float) -> None:
    """Mark the end of the flight: a star for a finished trial, a cross for any other."""
    if ended_by == "finished":
        axes.scatter(*end, s=size * 4, marker="*", color=PASSED, edgecolor="white", zorder=8)
    else:
        axes.scatter(*end, s=size * 2.4, marker="X", color=CRASH, edgecolor="white", zorder=8)


def _limits(track: Track, flight: Flight | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper corner (3,) of the region to draw [m]."""
    points = [track.start_pos_w[None], *(solid.vertices for solid in track_solids(track))]
    if flight is not None:
        points.append(flight.pos_w[np.isfinite(flight.pos_w).all(axis=1)])
    points_w = np.concatenate(points)
    low, high = points_w.min(axis=0) - MARGIN_M, points_w.max(axis=0) + MARGIN_M
    low[2] = min(-0.2, points_w[:, 2].min() - 0.2)
    high[2] = points_w[:, 2].max() + 0.4
    return low, high


def _speed_range(flights: Sequence[Flight | None]) -> Normalize:
    speeds = [np.linalg.norm(flight.vel_w, axis=1) for flight in flights if flight]
    return Normalize(0.0, max(map(colours.top_speed, speeds), default=1.0))


def _colour_bar(figure: Figure, axes: list[Axes], speed: Normalize) -> None:
    """Draw the colour scale of the speeds next to `axes`."""
    bar = figure.colorbar(
        ScalarMappable(speed, SPEED_MAP), ax=axes, fraction=0.03, aspect=32, pad=0.015
    )
    bar.set_label("speed [m/s]", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    bar.outline.set_visible(False)


def _legend(figure: Figure, trials: Sequence[Shown]) -> None:
    """Draw a legend of the marks above the views."""
    passed = [_passed(flight, result) for _, flight, result in trials]
    gates = [len(track.scene.gates.center_w) for track, _, _ in trials]
    marks: list[Artist] = [
        Line2D([], [], ls="", marker="o", mfc="white", mec=START, mew=1.8, ms=7, label="start"),
        Patch(facecolor=hex_text(colours.SOLID), edgecolor=GREY, label="obstacle"),
    ]
    if any(done < total for done, total in zip(passed, gates, strict=True)):
        label = "gate ahead" if any(passed) else "gate"
        marks.insert(1, Line2D([], [], color=hex_text(colours.AHEAD), lw=4, label=label))
    if any(passed):
        marks.insert(1, Line2D([], [], color=PASSED, lw=4, label="gate passed"))
    figure.legend(
        handles=marks, loc="outside upper right", ncols=len(marks), fontsize=8, frameon=False
    )


def _title(track: Track) -> str:
    return f"{track.family}  ·  level {track.level}  ·  seed {track.seed}"


def _outcome(result: TrialResult, short: bool = False) -> str:
    """Return the outcome of a trial as text; `short` leaves out speeds and names."""
    gates = "1 gate" if result.gates_passed == 1 else f"{result.gates_passed} gates"
    text = f"{result.ending} after {result.time_s:.2f} s, {gates} passed"
    if short:
        return text
    text += f", v_max {result.v_max:.1f} m/s, mean {result.v_mean:.1f} m/s"
    return f"{text}\npolicy {result.policy}, vehicle {result.vehicle}, simulator {result.world}"


def _save(figure: Figure, path: str | Path, dpi: int) -> Path:
    """Write a figure as a file, completely or not at all.

    Raises:
        ValueError: for an ending that is no format of a picture.
    """
    formats, ending = FigureCanvasAgg(figure).get_supported_filetypes(), Path(path).suffix
    if ending[1:].lower() not in formats:
        raise ValueError(f"{path}: ending {ending!r}; a picture ends in .png, .pdf or .svg")
    for text in figure.findobj(Text):
        text.set_parse_math(False)  # names of policies and tracks may have dollar signs
    with replacing_file(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
    return Path(path)

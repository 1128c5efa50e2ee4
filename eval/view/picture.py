"""Pictures of trials as PNG (or PDF, SVG), from above and from the side; need no display."""

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
from eval.view.colours import SPEED_MAP, hexed
from eval.view.solids import outline, track_solids
from eval.worlds.trial import TrialResult
from tracks.common.files import replacing_file
from tracks.track import Track

Shown = tuple[Track, Flight | None, TrialResult | None]
"""A track, with an optional flight and its result."""

TOP, SIDE = (0, 1), (0, 2)
"""World axes of a view, horizontal and vertical."""
MARGIN_M = 1.0
PATH_WIDTH = 2.2
PASSED, CRASH, START, GREY = map(
    hexed, (colours.PASSED, colours.CRASH, colours.START, colours.SOLID_EDGE)
)


def write_picture(
    path: str | Path,
    track: Track,
    flight: Flight | None = None,
    result: TrialResult | None = None,
    dpi: int = 130,
) -> Path:
    """Draw a trial, or a track without a flight, from above and from the side.

    Args:
        path: file to write; its ending sets the format.
        track: of the trial.
        flight: the path flown, coloured by speed.
        result: for the title and the mark at the end.
        dpi: dots per inch; the picture is up to 9.5 inches wide and 9.2 high.

    Raises:
        OSError: where the file cannot be written; nothing is left under its name.
    """
    low, high = _limits(track, flight)
    across, deep, tall = high - low
    # Both views have the same scale, so their heights follow from the track's extent.
    scale = min(7.6 / across, 7.5 / (deep + tall))
    size = (max(across * scale, 4.5) + 1.9, (deep + tall) * scale + 1.65)
    figure = Figure(figsize=size, layout="constrained")
    top, side = figure.subplots(2, 1, sharex=True, height_ratios=[deep, tall])
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
    return _save(figure, path, dpi)


def write_grid(path: str | Path, trials: Sequence[Shown], columns: int = 3, dpi: int = 110) -> Path:
    """Draw several trials from above, each in a panel, with one colour bar.

    Raises:
        ValueError: where `trials` is empty.
        OSError: where the file cannot be written; nothing is left under its name.
    """
    if not trials:
        raise ValueError("a grid needs at least one trial; got none")
    columns = min(columns, len(trials))
    rows = math.ceil(len(trials) / columns)
    limits = [_limits(track, flight) for track, flight, _ in trials]
    # Row heights follow from the shapes of their panels.
    shape = np.array([(high - low)[1] / (high - low)[0] for low, high in limits])
    shape = np.clip(shape, 0.3, 1.1)
    tall = [shape[row * columns : (row + 1) * columns].max() for row in range(rows)]
    panel = 4.2
    height = sum(panel * part + 0.85 for part in tall) + 0.5
    figure = Figure(figsize=(panel * columns + 0.9, height), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, height_ratios=tall)
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
            where = {"xycoords": "axes fraction", "textcoords": "offset points"}
            text = _outcome(result, short=True)
            axes.annotate(text, (0, 1), xytext=(0, 4), fontsize=8, color="#444444", **where)
    if any(flight is not None for _, flight, _ in trials):
        _colour_bar(figure, list(grid.flat), speed)
    _legend(figure, trials)
    return _save(figure, path, dpi)


def _draw(
    axes: Axes, shown: Shown, view: tuple[int, int], speed: Normalize, small: bool = False
) -> None:
    track, flight, result = shown
    if flight is not None and not len(flight.time_s):
        flight = None  # a trial that ended at its first step
    gates, passed = track.scene.gates, _passed(flight, result)
    solids = track_solids(track)
    obstacles = [solid.vertices for solid in solids if solid.gate is None]
    # Nearer solids are drawn later: higher ones from above, those of lower y from the side.
    obstacles.sort(key=lambda at: at[:, 2].max() if view == TOP else -at[:, 1].min())
    axes.add_collection(
        PolyCollection(
            [outline(at[:, view]) for at in obstacles],
            facecolor=hexed(colours.SOLID),
            edgecolor=hexed(colours.SOLID_EDGE),
            lw=0.6,
            alpha=0.75,
        )
    )
    bars = [solid for solid in solids if solid.gate is not None]
    colour = [_gate_colour(bar.gate, passed) for bar in bars]
    frames = [outline(bar.vertices[:, view]) for bar in bars]
    axes.add_collection(
        PolyCollection(frames, facecolor=colour, edgecolor=colour, lw=0.8, zorder=3)
    )
    if view == TOP:
        for number, (center, rot) in enumerate(zip(gates.center_w, gates.rot_w, strict=True)):
            _number(axes, number, center[:2], rot[:2, 0], _gate_colour(number, passed), small)
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
    """Return how many gates were passed."""
    if result is not None:
        return result.gates_passed
    return 0 if flight is None or not len(flight.time_s) else int(flight.gate.max())


def _gate_colour(number: int | None, passed: int) -> str:
    ahead = number is None or number >= passed
    return hexed(colours.AHEAD) if ahead else PASSED


def _draw_path(
    axes: Axes, flight: Flight, view: tuple[int, int], speed: Normalize, small: bool
) -> None:
    points = flight.pos_w[:, view]
    pieces = np.stack([points[:-1], points[1:]], axis=1)
    speeds = np.linalg.norm(flight.vel_w, axis=1)[:-1]
    width = PATH_WIDTH * (0.75 if small else 1.0)
    path = LineCollection(list(pieces), cmap=SPEED_MAP, norm=speed, lw=width, zorder=5)
    path.set_array(speeds)
    path.set_capstyle("round")
    axes.add_collection(path)


def _number(
    axes: Axes,
    number: int,
    center: np.ndarray,
    along: np.ndarray,
    colour: str,
    small: bool,
) -> None:
    away = 13 if not small else 8
    along = along / max(float(np.linalg.norm(along)), 1e-9)
    across = np.array([-along[1], along[0]])
    label = center + 0.75 * across
    # Numbered from 0, as in the names of what was collided with ("gate 3 frame").
    axes.annotate(
        str(number),
        (label[0], label[1]),
        xytext=tuple(across * away * 0.6),
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=6.5 if small else 9,
        color=colour,
        fontweight="bold",
        zorder=7,
    )
    if not small:
        tip = (center[0] + 0.55 * along[0], center[1] + 0.55 * along[1])
        arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.0, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", tip, xytext=(center[0], center[1]), arrowprops=arrow, zorder=4)


def _mark_end(axes: Axes, end: np.ndarray, ended_by: str, size: float) -> None:
    if ended_by == "finished":
        axes.scatter(*end, s=size * 4, marker="*", color=PASSED, edgecolor="white", zorder=8)
    else:
        axes.scatter(*end, s=size * 2.4, marker="X", color=CRASH, edgecolor="white", zorder=8)


def _limits(track: Track, flight: Flight | None) -> tuple[np.ndarray, np.ndarray]:
    points = [track.start_pos_w[None], *(solid.vertices for solid in track_solids(track))]
    if flight is not None:
        points.append(flight.pos_w[np.isfinite(flight.pos_w).all(axis=1)])
    every = np.concatenate(points)
    low, high = every.min(axis=0) - MARGIN_M, every.max(axis=0) + MARGIN_M
    low[2] = min(-0.2, every[:, 2].min() - 0.2)
    high[2] = every[:, 2].max() + 0.4
    return low, high


def _speed_range(flights: Sequence[Flight | None]) -> Normalize:
    speeds = [np.linalg.norm(flight.vel_w, axis=1) for flight in flights if flight]
    return Normalize(0.0, max(map(colours.top_speed, speeds), default=1.0))


def _colour_bar(figure: Figure, axes: list[Axes], speed: Normalize) -> None:
    bar = figure.colorbar(
        ScalarMappable(speed, SPEED_MAP), ax=axes, fraction=0.03, aspect=32, pad=0.015
    )
    bar.set_label("speed [m/s]", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    bar.outline.set_visible(False)


def _legend(figure: Figure, trials: Sequence[Shown]) -> None:
    """Name the marks that are drawn, above the views."""
    passed = [_passed(flight, result) for _, flight, result in trials]
    gates = [len(track.scene.gates.center_w) for track, _, _ in trials]
    grey = (hexed(colours.SOLID), hexed(colours.SOLID_EDGE))
    marks: list[Artist] = [
        Line2D([], [], ls="", marker="o", mfc="white", mec=START, mew=1.8, ms=7, label="start"),
        Patch(facecolor=grey[0], edgecolor=grey[1], label="obstacle"),
    ]
    if any(done < of for done, of in zip(passed, gates, strict=True)):
        words = "gate ahead" if any(passed) else "gate"
        marks.insert(1, Line2D([], [], color=hexed(colours.AHEAD), lw=4, label=words))
    if any(passed):
        marks.insert(1, Line2D([], [], color=PASSED, lw=4, label="gate passed"))
    figure.legend(
        handles=marks, loc="outside upper right", ncols=len(marks), fontsize=8, frameon=False
    )


def _title(track: Track) -> str:
    return f"{track.family}  ·  level {track.level}  ·  seed {track.seed}"


def _outcome(result: TrialResult, short: bool = False) -> str:
    gates = "1 gate" if result.gates_passed == 1 else f"{result.gates_passed} gates"
    text = f"{result.ending} after {result.time_s:.2f} s, {gates} passed"
    if short:
        return text
    text += f", v_max {result.v_max:.1f} m/s, mean {result.v_mean:.1f} m/s"
    return f"{text}\npolicy {result.policy}, vehicle {result.vehicle}, simulator {result.world}"


def _save(figure: Figure, path: str | Path, dpi: int) -> Path:
    FigureCanvasAgg(figure)
    for text in figure.findobj(Text):
        text.set_parse_math(False)  # a name of a policy or a track may hold dollar signs
    with replacing_file(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
    return Path(path)

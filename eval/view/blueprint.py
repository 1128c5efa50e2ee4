"""Layout of a recording: one tab for each trial, with track, depth image and plots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import rerun.blueprint as rrb

TIMELINE = "time"
"""The timeline of a trial, seconds from its start."""


class Tab(NamedTuple):
    """Inputs of the layout of one trial."""

    root: str
    """Entity path of the trial."""
    title: str
    has_depth: bool
    low_w: np.ndarray
    """(3,) lower corner of the visible region [m]."""
    high_w: np.ndarray
    """(3,) upper corner [m]."""


def layout(tabs: Sequence[Tab], shown_s: tuple[float, float]) -> rrb.Blueprint:
    """Return the blueprint of a recording of these trials, which plays the span `shown_s` [s]."""
    return tabbed([_tab(tab) for tab in tabs], shown_s)


def tabbed(parts: Sequence[rrb.Container], shown_s: tuple[float, float]) -> rrb.Blueprint:
    """Return a blueprint with a tab for each of `parts`, which plays the span `shown_s` [s].

    The viewer has no setting for the initial time, but a loop over a selection begins at its start.
    Without it a file opens at its last time. (A viewer of 0.41 that loads slowly plays from the
    start to the end and stops there.)
    """
    begin, end = (round(1e9 * time) for time in shown_s)
    return rrb.Blueprint(
        parts[0] if len(parts) == 1 else rrb.Tabs(*parts, active_tab=0),
        rrb.TimePanel(
            state="expanded",
            timeline=TIMELINE,
            play_state="playing",
            loop_mode="selection",
            time_selection=rrb.components.AbsoluteTimeRange(begin, max(end, begin + 1)),
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
    )


def _tab(tab: Tab) -> rrb.Vertical:
    world = f"{tab.root}/world"
    overview = rrb.Spatial3DView(
        origin=world,
        # Back-projected depth would hide the track, so only the view from behind shows it.
        contents=["$origin/**", "- $origin/drone/camera/**"],
        name="track",
        background=[245, 246, 248],
        line_grid=False,
        eye_controls=_overview(tab),
    )
    side_views: list[rrb.View] = [
        rrb.Spatial3DView(
            # In the drone's frame, so that the camera moves and turns with it.
            origin=f"{world}/drone",
            contents=[f"{world}/**", "- $origin/pin"],
            name="behind the drone",
            background=[245, 246, 248],
            line_grid=False,
            eye_controls=rrb.EyeControls3D(
                kind=rrb.Eye3DKind.Orbital,
                position=[-1.1, 0.0, 0.45],
                look_target=[0.6, 0.0, 0.15],
                eye_up=[0.0, 0.0, 1.0],
            ),
        )
    ]
    if tab.has_depth:
        camera = f"{world}/drone/camera"
        side_views.append(rrb.Spatial2DView(origin=camera, name="depth image"))
    plots = {
        "speed": "speed [m/s]",
        "rates": "body rates [rad/s]",
        "action": "policy's action, body [m/s²]",
        "thrust": "thrust command [m/s²]",
        "rotors": "rotor speeds [rad/s]",
    }
    speed, rates, *others = (
        rrb.TimeSeriesView(origin=f"{tab.root}/{name}", name=title) for name, title in plots.items()
    )
    events = rrb.TextLogView(
        origin=f"{tab.root}/events",
        name="events",
        columns=rrb.archetypes.TextLogColumns(text_log_columns=["body"]),
    )
    return rrb.Vertical(
        rrb.Horizontal(overview, rrb.Vertical(*side_views), column_shares=[2.2, 1.0]),
        rrb.Horizontal(speed, rates, rrb.Tabs(*others), events, column_shares=[2, 2, 2, 1]),
        row_shares=[3.0, 1.0],
        name=tab.title,
    )


def _overview(tab: Tab) -> rrb.EyeControls3D:
    """Return a camera above the track's long side that shows all of it."""
    middle, size = (tab.low_w + tab.high_w) / 2, tab.high_w - tab.low_w
    away = np.array([0.0, -1.0, 0.75]) if size[0] >= size[1] else np.array([1.0, 0.0, 0.75])
    distance = 0.57 * float(np.max(size[:2])) + 0.2 * float(np.min(size[:2])) + 1.0
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=middle + distance * away / np.linalg.norm(away),
        look_target=middle,
        eye_up=[0.0, 0.0, 1.0],
    )

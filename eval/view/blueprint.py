"""Layout of a recording in the rerun viewer: one tab for each trial, a flight along a track.

A tab has two views of the track, the policy's depth image, plots of the signals and the events.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import rerun.blueprint as rrb

TIMELINE = "time"
"""Name of the timeline of a trial, in seconds from its start."""
BACKGROUND = [245, 246, 248]
"""Colour behind the 3D views, 0-255."""


class Tab(NamedTuple):
    """Inputs of the layout of one trial."""

    root: str
    """Entity path of the trial in the recording."""
    title: str
    has_depth: bool
    """Whether the trial has depth images."""
    low_w: np.ndarray
    """(3,) lower corner of the visible region [m]."""
    high_w: np.ndarray
    """(3,) upper corner of the visible region [m]."""
    action_kind: str
    """Kind of the policy's action."""


def tabs_blueprint(
    views: Sequence[rrb.Container], playback_s: tuple[float, float]
) -> rrb.Blueprint:
    """Return a layout with a tab for each of `views`, which plays the span `playback_s` [s].

    The viewer has no setting for the initial time, and opens a file at its last time. So the layout
    plays a loop over a selection, which begins at the start of the selection. (If version 0.41 of
    the viewer loads slowly, it plays from the start to the end and stops there.)
    """
    begin, end = (round(1e9 * time) for time in playback_s)
    return rrb.Blueprint(
        views[0] if len(views) == 1 else rrb.Tabs(*views, active_tab=0),
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


def trial_view(tab: Tab) -> rrb.Vertical:
    """Return the views of one trial."""
    world = f"{tab.root}/world"
    overview = rrb.Spatial3DView(
        origin=world,
        # Points of the depth image would hide the track, so only the view from behind shows them.
        contents=["$origin/**", "- $origin/drone/camera/**"],
        name="track",
        background=BACKGROUND,
        line_grid=False,
        eye_controls=_overview_camera(tab),
    )
    side_views: list[rrb.View] = [
        rrb.Spatial3DView(
            # In the drone's frame, so that the camera moves and turns with it.
            origin=f"{world}/drone",
            contents=[f"{world}/**", "- $origin/pin"],
            name="behind the drone",
            background=BACKGROUND,
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
    is_acceleration = tab.action_kind == "acceleration"
    plots = {
        "speed": "speed [m/s]",
        "rates": "body rates [rad/s]",
        "action": "policy's action" + (", body [m/s²]" if is_acceleration else ""),
        "thrust": "thrust command [m/s²]",
        "rotors": "rotor speeds [rad/s]",
    }
    if tab.action_kind == "motors":  # it commands no thrust
        del plots["thrust"]
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


def _overview_camera(tab: Tab) -> rrb.EyeControls3D:
    """Return a camera above the track's long side that shows the whole track."""
    centre_w, size = (tab.low_w + tab.high_w) / 2, tab.high_w - tab.low_w
    # Towards the camera: perpendicular to the long side, 37 degrees above the horizon.
    direction = np.array([0.0, -1.0, 0.75]) if size[0] >= size[1] else np.array([1.0, 0.0, 0.75])
    # Chosen so that tracks of all shapes fill the view.
    distance = 0.57 * float(np.max(size[:2])) + 0.2 * float(np.min(size[:2])) + 1.0
    return rrb.EyeControls3D(
        kind=rrb.Eye3DKind.Orbital,
        position=centre_w + distance * direction / np.linalg.norm(direction),
        look_target=centre_w,
        eye_up=[0.0, 0.0, 1.0],
    )

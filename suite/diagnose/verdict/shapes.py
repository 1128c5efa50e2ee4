"""Plain shapes of a force or torque over the state: what a gap may look like that has no name.

None is physics. Each group is one shape along three axes, so that a gap that no effect of the
catalogue explains still says what it goes with.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eval.effects.interface import GRAVITY
from suite.diagnose.fit.rollout import KNOTS, Flown
from suite.diagnose.thresholds import THRESHOLDS, Thresholds


class ShapeGroup(NamedTuple):
    """One shape, as columns of `ShapeLibrary.unit`."""

    label: str
    """For people: "force that goes with ..."."""
    columns: tuple[int, ...]


class ShapeLibrary(NamedTuple):
    """All shapes on the knots of W windows."""

    unit: np.ndarray
    """(W, KNOTS * 6, J) acceleration and angular acceleration in body axes, for 1 of each."""
    groups: tuple[ShapeGroup, ...]


def shape_library(
    knot: Flown, start_s: np.ndarray, limits: Thresholds = THRESHOLDS
) -> ShapeLibrary:
    """Return all shapes on windows with the states `knot` (W, KNOTS, ...) at their knots.

    `start_s` (W,) is since the start of the flight [s].
    """
    pos_w, rot_w, vel_w, rate_b = (np.asarray(field) for field in knot.track)
    axes_b = np.swapaxes(rot_w, -1, -2)
    vel_b = (axes_b @ vel_w[..., None])[..., 0]
    thrust = np.asarray(knot.force_b)[..., 2] / GRAVITY
    change = np.gradient(thrust, axis=1) * (KNOTS - 1) * GRAVITY
    speed = np.sqrt((vel_w**2).sum(axis=-1))
    yaw = np.arctan2(rot_w[..., 1, 0], rot_w[..., 0, 0])
    time = start_s[:, None] + np.linspace(0.0, 1.0, KNOTS)
    scalars = {
        "nothing: it is constant": np.ones_like(speed),
        "the time in flight": time,
        "the height": pos_w[..., 2],
        "nearness to the ground": 1.0 / (0.1 + np.maximum(pos_w[..., 2], 0.0)) ** 2,
        "the speed": speed,
        "the speed's square": speed**2,
        "the climb": vel_w[..., 2],
        "the sinking": np.maximum(-vel_w[..., 2], 0.0) ** 2,
        **{f"the velocity along body {a}": vel_b[..., i] for i, a in enumerate("xyz")},
        **{f"the square along body {a}": vel_b[..., i] ** 2 for i, a in enumerate("xyz")},
        **{f"the {a} rate": rate_b[..., i] for i, a in enumerate(("roll", "pitch", "yaw"))},
        "the thrust": thrust,
        "the thrust's square": thrust**2,
        "the thrust's change": change,
        "the thrust's direction of change": np.tanh(change / limits.thrust_reversal),
        "thrust times velocity along x": thrust * vel_b[..., 0],
        "thrust times velocity along y": thrust * vel_b[..., 1],
        "the heading": np.cos(yaw),
        "the heading ": np.sin(yaw),
        "twice the heading": np.cos(2.0 * yaw),
        "twice the heading ": np.sin(2.0 * yaw),
    }
    columns: list[np.ndarray] = []
    groups: list[ShapeGroup] = []

    def add(label: str, shapes: list[np.ndarray]) -> None:
        groups.append(ShapeGroup(label, tuple(range(len(columns), len(columns) + len(shapes)))))
        columns.extend(shapes)

    six = np.eye(6)
    for label, scalar in scalars.items():
        along = scalar[..., None, None] * six
        add(f"force with {label.rstrip()}", [along[..., i, :] for i in range(3)])
        add(f"torque with {label.rstrip()}", [along[..., i, :] for i in range(3, 6)])
    motion = [hat[..., None] * vel_b for hat in _hats(speed, limits.pieces)]
    add("force with the motion, by its speed", [
        along_b[..., i, None] * six[i] for along_b in motion for i in range(3)
    ])  # fmt: skip
    for label, scalar in (("thrust", thrust), ("climb", vel_w[..., 2]), ("height", pos_w[..., 2])):
        add(
            f"force along body z, by the {label}",
            [h[..., None] * six[2] for h in _hats(scalar, limits.pieces)],
        )
    world = np.concatenate([axes_b, np.zeros_like(axes_b)], axis=-2)
    add("force along fixed directions", [world[..., i] for i in range(3)])
    add("force with the place", [
        world[..., i] * bump[..., None] for bump in _bumps(pos_w, limits.cells) for i in range(3)
    ])  # fmt: skip
    middle = pos_w.mean(axis=(0, 1))
    away = np.einsum("wkij,wkj->wki", axes_b, pos_w - middle)
    add("force towards a place", [np.concatenate([away, np.zeros_like(away)], axis=-1)])
    stacked = np.stack(columns, axis=-1)
    return ShapeLibrary(stacked.reshape(len(stacked), KNOTS * 6, -1), tuple(groups))


def _hats(scalar: np.ndarray, pieces: int) -> list[np.ndarray]:
    """Return hats over what values `scalar` (W, KNOTS) takes, as many between any two."""
    places = np.unique(np.quantile(scalar, np.linspace(0.0, 1.0, pieces + 1)))
    if len(places) < 2:
        return [np.ones_like(scalar)]
    return [np.interp(scalar, places, one) for one in np.eye(len(places))]


def _bumps(pos_w: np.ndarray, cells: int) -> list[np.ndarray]:
    """Return hats over the horizontal places that were flown, each (W, KNOTS)."""
    low, high = pos_w[..., :2].min(axis=(0, 1)), pos_w[..., :2].max(axis=(0, 1))
    width = np.maximum(high - low, 0.5) / (cells - 1)
    found = []
    for cell in np.ndindex(cells, cells):
        apart = (pos_w[..., :2] - low) / width - cell
        found.append(np.exp(-0.5 * (apart**2).sum(axis=-1) / 0.5**2))
    return found

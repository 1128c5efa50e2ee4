"""The next two gates as a detector sees them: pose by PnP from four corners, with gaps.

First-order covariance of the pose of a square of half side a, met face on at range r, from corners
with noise of s pixels at a focal length of f pixels: across s r / (sqrt(2) f), along the view
s r^2 / (sqrt(8) f a), tilt s r^2 / (2 f a^2). Out of view, or in a gap, the last estimate stands
where it stood in the estimator's own world; of a gate not seen yet, that is the map's place.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from eval.sensors.interface import Array, Moment, Needs, Parameter, Sensor, View, column, sticky
from tracks.geometry.camera import Camera, optical_axis_b
from tracks.geometry.rotation import exp_rot, to_local, to_world

NEAREST_M = 0.3
"""Nearer than this along the camera's axis, a gate's corners are out of its image [m]."""
ACROSS = 640
"""Pixels across the image that corners are found in."""


class GateDetection(NamedTuple):
    """Values of `gate_detection`."""

    pixels: Array
    """s: standard deviation of a corner in an image of 640 pixels across."""
    missed: Array
    """Share of the observations in which a gate in view is not detected."""
    length: Array
    """Mean duration of such a gap."""
    half_side: Array
    """a: half of the gate's side, as the detector assumes it."""
    known_tilt: Array
    """Standard deviation of a gate's tilt that is known without an image."""
    smoothing: Array
    """Time constant of the filter on the detected positions; 0: none."""


def start(values: GateDetection, moment: Moment) -> dict[str, Any]:
    """Return that no gate is held yet."""
    xp, truth = moment.truth.pos_w.__array_namespace__(), moment.truth
    gates_w = xp.stack([truth.gate_w, truth.second_w], axis=-2)
    missed = moment.draws.uniform < 0.0
    return {"gates_w": gates_w, "held": missed, "missed": missed, "number": truth.gate_number}


def sense(
    values: GateDetection, memory: dict[str, Any], seen: View, moment: Moment
) -> tuple[View, dict[str, Any]]:
    """Return the view with the gates where the detector has them, relative to the drone."""
    xp, truth, draws = seen.pos_w.__array_namespace__(), moment.truth, moment.draws
    map_w = xp.stack([seen.gate_w, seen.second_w], axis=-2)
    axes_w = xp.stack([seen.axis_w, seen.second_axis_w], axis=-2)
    true_w = xp.stack([truth.gate_w, truth.second_w], axis=-2)
    # After a gate the second one becomes the next, with its stored estimate.
    passed = column(truth.gate_number > memory["number"])
    moved_w = xp.concatenate([memory["gates_w"][..., 1:, :], map_w[..., 1:, :]], axis=-2)
    moved = xp.concatenate([memory["held"][..., 1:], memory["held"][..., 1:] & False], axis=-1)
    kept_w = xp.where(column(passed), moved_w, memory["gates_w"])
    held = xp.where(passed, moved, memory["held"])
    kept_w = xp.where(column(held), kept_w, map_w)

    there_b = to_local(truth.rot_w[..., None, :, :], true_w - truth.pos_w[..., None, :])
    share, gap = column(values.missed), column(values.length)
    missed = sticky(memory["missed"], draws.uniform, share, gap, moment.dt_s)
    found = in_view(there_b, moment.camera) & ~missed
    range_m = xp.sqrt((there_b**2).sum(-1) + 1e-6)
    across, along, tilt = spreads(values, range_m, moment.camera)
    normal = draws.normal.reshape(*draws.normal.shape[:-1], 2, 6)
    ray_b = there_b / column(range_m)
    depth = column((ray_b * normal[..., :3]).sum(-1)) * ray_b
    error_b = column(across) * (normal[..., :3] - depth) + column(along) * depth
    measured_w = seen.pos_w[..., None, :] + to_world(seen.rot_w[..., None, :, :], there_b + error_b)
    fresh = -xp.expm1(-moment.dt_s / xp.maximum(values.smoothing, 1e-9))
    fresh = xp.where(held, column(fresh), 1.0)
    gates_w = xp.where(column(found), kept_w + column(fresh) * (measured_w - kept_w), kept_w)
    tilted_w = to_world(exp_rot(column(tilt) * normal[..., 3:]), axes_w)
    axes_w = xp.where(column(found), tilted_w, axes_w)
    seen = seen._replace(
        gate_w=gates_w[..., 0, :],
        second_w=gates_w[..., 1, :],
        axis_w=axes_w[..., 0, :],
        second_axis_w=axes_w[..., 1, :],
    )
    number = truth.gate_number
    return seen, {"gates_w": gates_w, "held": held | found, "missed": missed, "number": number}


def spreads(values: GateDetection, range_m: Array, camera: Camera) -> tuple[Array, Array, Array]:
    """Return standard deviations across the view [m], along it [m] and of the tilt [rad].

    What is known of gates' tilt before, as that they stand upright where the map has them, bounds
    the tilt's.

    Args:
        values: the model's.
        range_m: (..., 2) of the two gates.
        camera: whose horizontal field of view `ACROSS` pixels cover.
    """
    xp = range_m.__array_namespace__()
    focal = ACROSS / 2 / math.tan(math.radians(camera.fov_deg[0]) / 2)
    angle, half, known = column(values.pixels) / focal, column(values.half_side), values.known_tilt
    half, known = xp.maximum(half, 1e-3), column(known)
    tilt = angle * range_m**2 / (2.0 * half**2)
    tilt = tilt * known / xp.sqrt(tilt**2 + known**2 + 1e-12)
    return angle * range_m / math.sqrt(2), angle * range_m**2 / (math.sqrt(8) * half), tilt


def in_view(there_b: Array, camera: Camera) -> Array:
    """Return whether points (..., 3) in body axes are in the camera's image."""
    forward = optical_axis_b(camera)
    up = np.array([-forward[2], 0.0, forward[0]])
    ahead = there_b[..., 0] * forward[0] + there_b[..., 2] * forward[2]
    above = there_b[..., 0] * up[0] + there_b[..., 2] * up[2]
    wide, high = (math.tan(math.radians(angle) / 2) for angle in camera.fov_deg)
    inside = (abs(there_b[..., 1]) < wide * ahead) & (abs(above) < high * ahead)
    return inside & (ahead > NEAREST_M)


SENSOR = Sensor(
    name="gate_detection",
    stage="gates",
    summary="The next gates are detected: noise of corners as PnP gives it, gaps, out of view",
    equation="p = p_true + e, e normal: s r / (sqrt(2) f) across, s r^2 / (sqrt(8) f a) along the "
    "view; gaps: Markov chain, `missed` of the observations, `length` at a time",
    source="first-order covariance of PnP, gate face on; Foehn et al. 2022 (AlphaPilot), Kaufmann "
    "et al. 2023 (Swift): corners within 1 to 3 pixels; gaps are our estimate",
    values=GateDetection,
    parameters=(
        Parameter("pixels", "pixel", 0.0, 0.0, 50.0, (0.5, 3.0)),
        Parameter("missed", "1", 0.0, 0.0, 0.95, (0.05, 0.3)),
        Parameter("length", "s", 0.0, 0.0, 10.0, (0.05, 0.3)),
        Parameter("half_side", "m", 0.5, 0.05, 10.0, (0.4, 0.8)),
        Parameter("known_tilt", "rad", 0.1, 0.0, 1.0, (0.05, 0.2)),
        Parameter("smoothing", "s", 0.0, 0.0, 10.0, (0.05, 0.3)),
    ),
    grows=("pixels", "missed"),
    trial=Needs(uniform=2),
    observation=Needs(normal=12, uniform=2),
    start=start,
    sense=sense,
)

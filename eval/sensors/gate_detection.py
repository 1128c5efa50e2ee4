"""Sensor model `gate_detection`: a detector measures the poses of the next two gates.

The detector computes a gate's pose from its four corners by PnP (perspective-n-point). The standard
deviations are those of first order for a square of half side a at range r, seen frontally. Its
corners have a noise of s pixels at a focal length of f pixels. The standard deviations are
s r / (sqrt(2) f) across the view, s r^2 / (sqrt(8) f a) along the view, and s r^2 / (2 f a^2) for
the tilt. While a gate is out of view or not detected, its last estimate in the estimator's world
frame is used. Before the first detection, its position in the map is used.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from eval.sensors.interface import (
    Array,
    Moment,
    Needs,
    Parameter,
    Sensor,
    View,
    column,
    markov_step,
)
from tracks.geometry.camera import Camera, optical_axis_b
from tracks.geometry.rotation import exp_rot, to_local, to_world

NEAREST_M = 0.3
"""Nearer than this along the camera's axis, a gate's corners are out of the image [m]."""
ACROSS = 640
"""Width of the image in which corners are detected [pixel]."""


class GateDetection(NamedTuple):
    """Parameters of `gate_detection`; units in `SENSOR`, letters as in the module's docstring."""

    pixels: Array
    """s: standard deviation of a corner in an image of 640 pixels across."""
    missed: Array
    """Share of the observations in which a gate in view is not detected."""
    length: Array
    """Mean duration of a gap without detections."""
    half_side: Array
    """a: half of the gate's side, as the detector assumes it."""
    known_tilt: Array
    """Standard deviation of a gate's tilt that is known without an image."""
    smoothing: Array
    """Time constant of the filter on the detected positions; 0: none."""


def start(values: GateDetection, moment: Moment) -> dict[str, Any]:
    """Return the state at the start, in which no gate has been detected."""
    xp, truth = moment.truth.pos_w.__array_namespace__(), moment.truth
    gates_w = xp.stack([truth.gate_w, truth.second_w], axis=-2)
    missed = moment.draws.uniform < 0.0
    return {"gates_w": gates_w, "held": missed, "missed": missed, "number": truth.gate_number}


def sense(
    values: GateDetection, memory: dict[str, Any], seen: View, moment: Moment
) -> tuple[View, dict[str, Any]]:
    """Return the view with the gates at their estimated poses, and the model's new state."""
    xp, truth, draws = seen.pos_w.__array_namespace__(), moment.truth, moment.draws
    map_w = xp.stack([seen.gate_w, seen.second_w], axis=-2)
    axes_w = xp.stack([seen.axis_w, seen.second_axis_w], axis=-2)
    true_w = xp.stack([truth.gate_w, truth.second_w], axis=-2)
    # When a gate is passed, the second one becomes the next, with its stored estimate and gap.
    change = truth.gate_number - memory["number"]
    passed = column(change == 1)
    next_w = xp.concatenate([memory["gates_w"][..., 1:, :], map_w[..., 1:, :]], axis=-2)
    held, missed = (
        xp.where(passed, xp.concatenate([flag[..., 1:], flag[..., 1:] & False], axis=-1), flag)
        for flag in (memory["held"], memory["missed"])
    )
    stored_w = xp.where(column(passed), next_w, memory["gates_w"])
    # After another change, such as to an older view by varying delays, they are of other gates.
    held = held & column((change == 0) | (change == 1))
    stored_w = xp.where(column(held), stored_w, map_w)  # without an estimate, the map

    # Detect gates in view, and measure their positions with the errors of PnP.
    gates_b = to_local(truth.rot_w[..., None, :, :], true_w - truth.pos_w[..., None, :])
    share, gap_s = column(values.missed), column(values.length)
    missed = markov_step(missed, xp.asarray(draws.uniform), share, gap_s, moment.dt_s)
    detected = in_view(gates_b, moment.camera) & ~missed
    range_m = xp.sqrt((gates_b**2).sum(-1) + 1e-6)
    across, along, tilt = spreads(values, range_m, moment.camera)
    normal = draws.normal.reshape(*draws.normal.shape[:-1], 2, 6)
    ray_b = gates_b / column(range_m)
    along_ray = column((ray_b * normal[..., :3]).sum(-1)) * ray_b
    error_b = column(across) * (normal[..., :3] - along_ray) + column(along) * along_ray
    measured_w = seen.pos_w[..., None, :] + to_world(seen.rot_w[..., None, :, :], gates_b + error_b)
    # Filter the measured positions; without a detection, keep the stored ones.
    weight = -xp.expm1(-moment.dt_s / xp.maximum(values.smoothing, 1e-9))
    weight = xp.where(held, column(weight), 1.0)
    filtered_w = stored_w + column(weight) * (measured_w - stored_w)
    gates_w = xp.where(column(detected), filtered_w, stored_w)
    tilted_w = to_world(exp_rot(column(tilt) * normal[..., 3:]), axes_w)
    axes_w = xp.where(column(detected), tilted_w, axes_w)
    seen = seen._replace(
        gate_w=gates_w[..., 0, :],
        second_w=gates_w[..., 1, :],
        axis_w=axes_w[..., 0, :],
        second_axis_w=axes_w[..., 1, :],
    )
    number = truth.gate_number
    return seen, {"gates_w": gates_w, "held": held | detected, "missed": missed, "number": number}


def spreads(values: GateDetection, range_m: Array, camera: Camera) -> tuple[Array, Array, Array]:
    """Return standard deviations across the view [m], along it [m] and of the tilt [rad], (..., 2).

    The tilt combines the measured one with `known_tilt`, as gates stand upright in the map.
    `range_m` (..., 2) are the distances of the two gates [m]. `ACROSS` pixels cover the camera's
    horizontal field of view.
    """
    xp = range_m.__array_namespace__()
    focal_px = ACROSS / 2 / math.tan(math.radians(camera.fov_deg[0]) / 2)
    angle, known_tilt = column(values.pixels) / focal_px, column(values.known_tilt)
    half_side = xp.maximum(column(values.half_side), 1e-3)
    tilt = angle * range_m**2 / (2.0 * half_side**2)
    tilt = tilt * known_tilt / xp.sqrt(tilt**2 + known_tilt**2 + 1e-12)
    return angle * range_m / math.sqrt(2), angle * range_m**2 / (math.sqrt(8) * half_side), tilt


def in_view(point_b: Array, camera: Camera) -> Array:
    """Return whether points (..., 3) in body axes [m] are in the camera's image, bool (...,)."""
    forward = optical_axis_b(camera)
    up = np.array([-forward[2], 0.0, forward[0]])
    ahead = point_b[..., 0] * forward[0] + point_b[..., 2] * forward[2]
    above = point_b[..., 0] * up[0] + point_b[..., 2] * up[2]
    half_width, half_height = (math.tan(math.radians(angle) / 2) for angle in camera.fov_deg)
    inside = (abs(point_b[..., 1]) < half_width * ahead) & (abs(above) < half_height * ahead)
    return inside & (ahead > NEAREST_M)


SENSOR = Sensor(
    name="gate_detection",
    stage="gates",
    summary="A detector measures the next gates: errors of PnP from corners, gaps, limited view",
    equation="p = p_true + e, e normal: s r / (sqrt(2) f) across, s r^2 / (sqrt(8) f a) along the "
    "view; gaps: Markov chain, `missed` of the observations, `length` at a time",
    source="first-order covariance of PnP, frontal gate; Foehn et al. 2022 (AlphaPilot), Kaufmann "
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

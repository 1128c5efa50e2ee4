"""Assemble the observation of a policy: a state of 12 or more numbers, and a depth image.

The first 12 numbers are those of Su et al. 2026, Eq. 1; a spec may add optional ones (extras).
Training, evaluation, simulators and Gymnasium environments all use `observe`. To add a vector, add
a key to `policies.spec.EXTRAS` and a line to `EXTRA_VECTORS`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from policies.spec import EXTRAS, DepthEncoding, PolicySpec
from tracks.geometry.rotation import to_local
from tracks.geometry.scene import Array, Gates


class View(NamedTuple):
    """The observable state of drones and their gates; NumPy or JAX arrays with any batch shape."""

    pos_w: Any
    """(..., 3) position [m]."""
    rot_w: Any
    """(..., 3, 3) attitude, body to world."""
    vel_w: Any
    """(..., 3) velocity [m/s]."""
    gate_w: Any
    """(..., 3) centre of the next gate [m]."""
    second_w: Any
    """(..., 3) centre of the gate after the next, or of the last gate [m]."""
    axis_w: Any
    """(..., 3) unit vector through the next gate, in flight direction."""
    second_axis_w: Any
    """(..., 3) unit vector through the gate of `second_w`."""
    depth_m: Any = None
    """(..., H, W) planar depth, clipped to the camera's range [m]; None without a camera."""
    gate_number: Any = None
    """(...,) number of the next gate from 0; None if no sensor model needs it."""


class Observation(NamedTuple):
    """The inputs of a policy."""

    state: Any
    """(..., spec.state_size) state: velocity in body axes [m/s], the third row of the attitude
    matrix R (world z in body axes), the next gate's centre in body axes [m], the last action (SI
    units of its kind), and the spec's extras."""
    image: Any
    """(..., *spec.image_shape) inverse depth, encoded by the spec; None without a depth image."""


def view_of(
    pos_w: Array, rot_w: Array, vel_w: Array, gate: Gates, after: Gates, depth_m: Array | None
) -> View:
    """Return the view (N, ...) of N drones.

    Args:
        pos_w: (N, 3) positions [m].
        rot_w: (N, 3, 3) attitudes, body to world.
        vel_w: (N, 3) velocities [m/s].
        gate: each drone's next gate, (N, ...).
        after: each drone's gate after the next, (N, ...).
        depth_m: (N, H, W) planar depth images [m], or None.
    """
    axes_w = gate.rot_w[..., 0], after.rot_w[..., 0]
    return View(pos_w, rot_w, vel_w, gate.center_w, after.center_w, *axes_w, depth_m)


EXTRA_VECTORS: dict[str, Callable[[View], Array]] = {
    "second_gate": lambda view: to_local(view.rot_w, view.second_w - view.pos_w),
    "gate_axis": lambda view: to_local(view.rot_w, view.axis_w),
    "second_axis": lambda view: to_local(view.rot_w, view.second_axis_w),
}
"""Key of a `PolicySpec` -> function that returns the vector (..., 3) of that key, in body axes."""


def observe(
    spec: PolicySpec, view: View, last_action_b: Array, speed: Array | None = None
) -> Observation:
    """Return the observation of a policy with `spec`.

    Args:
        spec: the policy's specification, with its extras and depth encoding.
        view: the observable state.
        last_action_b: (..., spec.action.size) the previous action in SI units, in the body axes at
            the time of that action.
        speed: (...,) commanded speed, 0 to 1, if the spec has that input; None: the spec's value.
    """
    rot_w = view.rot_w
    vel_b, gate_b = to_local(rot_w, view.vel_w), to_local(rot_w, view.gate_w - view.pos_w)
    numbers = [vel_b, rot_w[..., 2, :], gate_b, last_action_b]
    xp = rot_w.__array_namespace__()
    for key in (key for key in EXTRAS if getattr(spec, key)):
        if key == "speed_input":
            speed_input = xp.full_like(vel_b[..., 0], spec.speed) if speed is None else speed
            numbers.append(speed_input[..., None])
        else:
            numbers.append(EXTRA_VECTORS[key](view))
    state = xp.concatenate(numbers, axis=-1)
    if view.depth_m is None:
        return Observation(state, None)
    image = encode_depth(spec.depth, view.depth_m, spec.camera.range_m)
    return Observation(state, image[..., None, :, :] if spec.depth.channel_axis else image)


def encode_depth(encoding: DepthEncoding, depth_m: Array, range_m: float) -> Array:
    """Return the policy's image input (encoded inverse depth) for planar depths [m]."""
    xp = depth_m.__array_namespace__()
    encoded = encoding.scale / xp.clip(depth_m, encoding.near, range_m) - encoding.offset
    if not encoding.uint8:
        return encoded
    low, high = encoding.bounds(range_m)
    return xp.rint(255.0 * (encoded - low) / (high - low))

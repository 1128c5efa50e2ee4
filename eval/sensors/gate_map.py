"""Sensor model `gate_map`: the drone's map of the gates is wrong.

The whole map is shifted, rotated about z and scaled, and each gate is displaced and rotated. The
errors are constant in a trial. The centre of rotation and scaling is the trial's start position.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from eval.sensors.interface import Array, Moment, Needs, Parameter, Sensor, View, column
from tracks.geometry.rotation import to_world, yaw_rotation

GATES = 32
"""Number of different gate errors; a track with more gates repeats them."""


class GateMap(NamedTuple):
    """Parameters of `gate_map`, all standard deviations over trials.

    Units are in `SENSOR`, letters as in its `equation`.
    """

    shift: Array
    """t: standard deviation of the shift of all gates, for each axis."""
    yaw: Array
    """psi: standard deviation of the rotation of the map about the vertical."""
    scale: Array
    """k: standard deviation of the map's relative error of scale."""
    moved: Array
    """m_i: standard deviation of each gate's own displacement, for each axis."""
    turned: Array
    """Standard deviation of each gate's own rotation about the vertical axis."""


def start(values: GateMap, moment: Moment) -> dict[str, Any]:
    """Return the centre of the map's errors, and the errors of the trial."""
    draws, pos_w = moment.draws.normal, moment.truth.pos_w
    moved = draws[..., 5 : 5 + 3 * GATES].reshape(*draws.shape[:-1], GATES, 3)
    return {
        "origin_w": pos_w,
        "shift_w": column(values.shift) * draws[..., :3],
        "yaw": values.yaw * draws[..., 3],
        "scale": 1.0 + values.scale * draws[..., 4],
        "moved_w": values.moved[..., None, None] * moved,
        "turned": column(values.turned) * draws[..., 5 + 3 * GATES :],
    }


def sense(
    values: GateMap, memory: dict[str, Any], seen: View, moment: Moment
) -> tuple[View, dict[str, Any]]:
    """Return the view with both gates at their poses in the map."""
    number = moment.truth.gate_number % GATES
    # After the last gate, the view repeats it as the second gate.
    no_second_gate = (moment.truth.second_w == moment.truth.gate_w).all(-1)
    second_number = (number + (~no_second_gate).astype(number.dtype)) % GATES
    gate_w, axis_w = _in_map(memory, seen.gate_w, seen.axis_w, number)
    second_w, second_axis_w = _in_map(memory, seen.second_w, seen.second_axis_w, second_number)
    seen = seen._replace(
        gate_w=gate_w, axis_w=axis_w, second_w=second_w, second_axis_w=second_axis_w
    )
    return seen, memory


def _in_map(
    memory: dict[str, Any], gate_w: Array, axis_w: Array, number: Array
) -> tuple[Array, Array]:
    """Return the position and axis (..., 3) of gate `number` (...,) in the map."""
    xp = gate_w.__array_namespace__()
    moved_w = xp.take_along_axis(memory["moved_w"], number[..., None, None], axis=-2)[..., 0, :]
    turned = xp.take_along_axis(memory["turned"], number[..., None], axis=-1)[..., 0]
    offset_w = to_world(yaw_rotation(memory["yaw"]), gate_w - memory["origin_w"])
    mapped_w = memory["origin_w"] + column(memory["scale"]) * offset_w + memory["shift_w"] + moved_w
    return mapped_w, to_world(yaw_rotation(memory["yaw"] + turned), axis_w)


SENSOR = Sensor(
    name="gate_map",
    stage="gates",
    summary="The map of the gates has errors, and gates were moved after it was made",
    equation="p = o + (1 + k) Rz(psi) (p_true - o) + t + m_i, normal k, psi, t, m_i of the trial",
    source="Foehn et al. 2022 (AlphaPilot): gates up to decimetres from their surveyed positions; "
    "usual sizes are our estimate",
    values=GateMap,
    parameters=(
        Parameter("shift", "m", 0.0, 0.0, 5.0, (0.02, 0.2)),
        Parameter("yaw", "rad", 0.0, 0.0, 1.0, (0.002, 0.02)),
        Parameter("scale", "1", 0.0, 0.0, 0.5, (0.001, 0.01)),
        Parameter("moved", "m", 0.0, 0.0, 5.0, (0.02, 0.2)),
        Parameter("turned", "rad", 0.0, 0.0, 1.0, (0.02, 0.1)),
    ),
    grows=("shift", "yaw", "scale", "moved", "turned"),
    trial=Needs(normal=5 + 4 * GATES),
    start=start,
    sense=sense,
)

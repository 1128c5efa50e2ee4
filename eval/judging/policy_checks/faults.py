"""Probable faults of a policy's camera, inputs and outputs, from synthetic observations.

A policy with a wrong unit, sign or frame flies as badly as an untrained one. A correct policy
accelerates towards a gate to one side, against a velocity to that side, and away from a near object
there. So a missing or opposite answer shows which input or output is wrong.
"""

from __future__ import annotations

import copy

import numpy as np

from eval.judging.guard import ActionLimits
from eval.judging.policy_checks.in_flight import (
    GRAVITY_FIX,
    INPUTS,
    SCALE_FIX,
    UNIT,
    UNIT_FIX,
    scale_advice,
)
from eval.judging.policy_checks.responses import Responses, last_action, level_states, responses
from eval.judging.policy_checks.rows import check_rows
from eval.logs.faults.vehicle import narrow_view
from policies.observation import encode_depth
from policies.policy import Policy
from policies.spec import Note

LIFT = 3.0
"""If a policy's vertical acceleration is always above this [m/s^2], even towards a gate below, its
outputs contain gravity or its inputs are wrong."""
GRAVITY_MEAN = 9.0
"""Mean vertical acceleration towards gates above and below [m/s^2] that indicates gravity. Policies
of the suite have 1 to 4; with inputs in wrong units up to 8."""
CLEAR = 0.5
"""Smallest difference of outputs between gates on opposite sides that counts [m/s^2]."""
CLEAR_RATE = 0.2
"""The same for body rates [rad/s]."""
DOMINANT = 1.5
"""If one component of an output answers to an offset by this factor more than the others, it is the
axis of this offset."""
THRUST = (6.0, 40.0)
"""Plausible mean of the commanded thrust per mass [m/s^2]."""
RATE_MOST = 35.0
"""Largest plausible body rate [rad/s], 2000 deg/s."""
DAMPING_LEAST_S, DAMPING_WRONG_S = 0.3, -0.3
"""`Responses.damping_s` below which a velocity hardly counts, or has the other sign. Six policies
of the suite have 0.9 to 1.7 s."""
APPROACH = 0.1
"""`Responses.approach` above which a policy flies towards objects; the six have -0.8 to -0.1."""
IMAGE_FACTOR, NO_CHANGE = 1.5, 1e-3
"""Factor on a test image; relative change of the output below which it counts as unchanged."""
SHORT_TRAINING = "; after a very short training this is no fault"
AXES = (("y", "left", "right"), ("z", "up", "down"))
"""Name and directions of the axes of an offset."""


def notes_of(policy: Policy) -> tuple[Note, ...]:
    """Return the notes about a policy before it flies.

    They are those of `check_rows`, the assumptions about its file, and the probable faults of its
    outputs. Of an object that is from no file, only the rows are tested.
    """
    rows, notes = check_rows(policy), notes_of_file(policy)
    return rows if notes is None else (*rows, *notes, *probable_faults(policy))


def notes_of_file(policy: Policy) -> tuple[Note, ...] | None:
    """Return the assumptions about a policy's file; None for an object of the user's own class."""
    notes = getattr(policy, "notes", None)
    is_own = isinstance(notes, tuple) and all(isinstance(note, Note) for note in notes)
    return notes if is_own else None


def object_faults(policy: Policy) -> tuple[Note, ...]:
    """Return the probable faults of a policy object, of which a copy is tested.

    An object that cannot be copied, or fails with test inputs, is not tested.
    """
    try:
        with np.errstate(all="ignore"):
            faults = probable_faults(copy.deepcopy(policy))
    except Exception:  # any error of an object's own code
        return ()
    return tuple(
        doubt._replace(evidence=doubt.evidence.removeprefix(f"{policy.name}: ")) for doubt in faults
    )


def probable_faults(policy: Policy) -> tuple[Note, ...]:
    """Return the probable faults of unit, scale, sign and frame of a policy."""
    kind, notes = policy.spec.action.kind, []
    if text := narrow_view(policy.spec.camera.fov_deg):
        notes.append(Note("camera_fov", text, "camera.fov_deg in degrees, not radians"))
    checks = {"acceleration": _acceleration_faults, "ctbr": _ctbr_faults}
    if kind in checks:
        found = responses(policy)
        if not np.isfinite(found.action).all():
            text = "outputs NaN or infinity in level flight towards a gate"
            fix = "check its weights and its normalisation"
            notes.append(Note("action_not_finite", text, fix))
        else:
            notes += checks[kind](policy, found) or _input_faults(policy, found)
    return tuple(note._replace(evidence=f"{policy.name}: {note.evidence}") for note in notes)


def _acceleration_faults(policy: Policy, found: Responses) -> list[Note]:
    """Return the probable faults of an action of kind `acceleration`."""
    action, is_plain = found.action, policy.spec.action.is_plain
    largest = float(np.linalg.norm(action, axis=-1).max())
    if largest > ActionLimits().size:
        text = f"commands up to {largest:.0f} m/s^2 in level flight, more than the limit"
        return [Note("action_limited", text, UNIT_FIX + scale_advice(policy.spec.action))]
    notes = []
    sideways, up = found.gate[0, 1], found.gate[1, 2]
    if order := _order(*found.gate):
        text = f"accelerates towards gates as if its action were in the order {order}"
        notes.append(Note("action_order", text, "an action is in the order x, y, z" + INPUTS))
    elif sideways < -CLEAR and up < -CLEAR:
        text = "accelerates away from gates to the left and above, as if its action were FRD"
        notes.append(Note("action_frame", text, "the suite uses FLU: negate y and z" + INPUTS))
    elif min(sideways, up) < -CLEAR:
        axis, side, _ = AXES[0] if sideways < up else AXES[1]
        text = f"accelerates away from gates offset in {axis}, as if {axis} were negated"
        fix = f"the suite's {axis} points {side}: negate it" + INPUTS
        notes.append(Note("action_frame", text, fix))
    least = action[:, 2].min()
    if least > LIFT and not order:
        text = f"commands at least {least:.1f} m/s^2 up in level flight, even towards a gate below"
        if action[2:4, 2].mean() > GRAVITY_MEAN:
            text += ", as if its action contained gravity"
            notes.append(Note("action_gravity", text, GRAVITY_FIX))
        else:
            fix = "compare units, signs and order of its state and image with the contract"
            notes.append(Note("input_units", text, f"{fix}; or its action contains gravity"))
    if not found.output.any():
        text = "outputs exactly 0 for gates far to the side, with no object in its image"
        fix = "look for a condition on its image, whose encoding is in the contract, or dead units"
        notes.append(Note("action_zero", text, fix))
    elif is_plain and np.abs(found.output).max() <= UNIT:
        text = "outputs only -1 to 1 m/s^2 for gates far to the side, as if unscaled"
        notes.append(Note("action_scale", text, SCALE_FIX))
    return notes


def _ctbr_faults(policy: Policy, found: Responses) -> list[Note]:
    """Return the probable faults of an action of kind `ctbr`: thrust, roll, pitch and yaw rate."""
    thrust, largest = float(found.action[:, 0].mean()), float(np.abs(found.action[:, 1:]).max())
    if not THRUST[0] <= thrust <= THRUST[1]:
        text = f"commands a thrust of {thrust:.3g} m/s^2 in level flight towards a gate"
        fix = (
            "thrust is per mass [m/s^2], with gravity: 9.81 in hover, no share and no force. It is "
            "the first of thrust, roll, pitch, yaw; or set action.scale"
        )
        return [Note("action_thrust", text, fix)]
    if largest > RATE_MOST:
        text = f"commands body rates of up to {largest:.0f} rad/s in level flight"
        return [Note("action_rates", text, "body rates in rad/s, not deg/s; or set action.scale")]
    roll, pitch, yaw = found.gate[0, 1:]
    if abs(pitch) > max(CLEAR_RATE, DOMINANT * abs(roll), DOMINANT * abs(yaw)):
        text = "answers gates to the left and right with its pitch rate"
        return [Note("action_order", text, "the order is thrust, roll, pitch, yaw" + INPUTS)]
    rates = {"roll": roll, "pitch": -found.slow[2], "yaw": -yaw}
    wrong = [name for name, rate in rates.items() if rate > CLEAR_RATE]
    if not wrong:
        return []
    text = f"turns away from gates with its {' and '.join(wrong)} rate, as if negated"
    fix = (
        "axes are FLU: a positive roll rate lowers the right side, a positive pitch rate the nose, "
        "a positive yaw rate turns left"
    )
    return [Note("action_frame", text, fix + INPUTS)]


def _input_faults(policy: Policy, found: Responses) -> list[Note]:
    """Return the probable faults of velocity and image, for an action that is right.

    Signs and directions count only if the policy clearly steers to gates on both axes.
    """
    notes = []
    if _divides_images(policy):
        text = f"has the same output for an image and for {IMAGE_FACTOR:g} times that image"
        fix = "an image without scale contains no distances: do not divide it by its maximum"
        notes.append(Note("image_scale", text, fix))
    if np.linalg.norm(found.gate, axis=-1).min() < CLEAR:
        return notes
    damping_s, approach = found.damping_s, found.approach
    unlike = [axis for axis, value in zip(AXES, damping_s, strict=True) if value < DAMPING_WRONG_S]
    if unlike:
        names = " and ".join(axis for axis, _, _ in unlike)
        text = f"accelerates along a velocity in {names}, not against it"
        fix = f"the {names} axis of the velocity in its state has the other sign (FLU, body axes)"
        notes.append(Note("velocity_sign", text, fix + SHORT_TRAINING))
    elif damping_s.max() < DAMPING_LEAST_S:
        text = "hardly decelerates if it drifts to the side of a gate"
        fix = "velocities in m/s and gates in m, both in body axes"
        notes.append(Note("velocity_scale", text, fix + SHORT_TRAINING))
    flipped = [axis for axis, value in zip(AXES, approach, strict=True) if value > APPROACH]
    if flipped:
        names = " and ".join(f"{first} or {second}" for _, first, second in flipped)
        text = f"flies towards near objects ({names}), not away from them"
        fix = (
            "the first row of an image is the top and its first column the left, and a nearer "
            "object has a larger value"
        )
        notes.append(Note("image_flipped", text, fix + SHORT_TRAINING))
    return notes


def unused_inputs(policy: Policy) -> list[Note]:
    """Return a note on the inputs that never change the action, though the policy has them."""
    spec = policy.spec
    state, other = level_states(spec, np.zeros((2, 2))), level_states(spec, np.ones((2, 2)))
    moved = state.copy()
    moved[:, last_action(spec)] += 1.0
    depths_m = np.full((2, 2, *spec.image_shape), spec.camera.range_m)
    depths_m[1] = spec.depth.near
    far, near = encode_depth(spec.depth, depths_m, spec.camera.range_m).astype(np.float32)
    fresh = np.ones(2, bool)
    usual, hidden = policy.act(policy.start(2), state, far, fresh)
    hidden = policy.act(hidden, other, near, ~fresh)[1]
    answers = {
        "image": policy.act(policy.start(2), state, near, fresh)[0],
        "last action": policy.act(policy.start(2), moved, far, fresh)[0],
    }
    if np.size(hidden):
        answers["memory"] = policy.act(hidden, state, far, ~fresh)[0]
    unused = [name for name, answer in answers.items() if np.array_equal(answer, usual)]
    if not unused:
        return []
    text = f"its action does not depend on its {' or '.join(unused)}"
    return [Note("input_unused", text, "if it should, check how this input enters the policy")]


def _order(sideways: np.ndarray, up: np.ndarray) -> str:
    """Return the order in which an action has its axes, such as "z, x, y"; "" if it has no other.

    `sideways` and `up` (3,) are differences of the action between gates to the left and right, and
    above and below.
    """
    axes = ["x", "x", "x"]
    for name, change in (("y", sideways), ("z", up)):
        *others, largest = np.sort(np.abs(change))
        if largest < max(CLEAR, DOMINANT * others[-1]):
            return ""
        axes[int(np.argmax(np.abs(change)))] = name
    return ", ".join(axes) if sorted(axes) == ["x", "y", "z"] and axes != ["x", "y", "z"] else ""


def _divides_images(policy: Policy) -> bool:
    """Return whether a policy ignores the scale of an image but uses its contents.

    The test compares its outputs for an image, for the scaled image and for the flipped image.
    """
    spec = policy.spec
    rows = np.linspace(0.5, 2.0, spec.image_shape[-2])[:, None]
    falling = np.broadcast_to(rows if not spec.depth.uint8 else 50 * rows, spec.image_shape)
    image = np.stack([falling, IMAGE_FACTOR * falling, np.flip(falling, -2)]).astype(np.float32)
    state, fresh = level_states(spec, np.zeros((len(image), 2))), np.ones(len(image), bool)
    outputs = np.asarray(policy.act(policy.start(len(image)), state, image, fresh)[0], float)
    scaled, flipped = np.abs(outputs[1:] - outputs[0]).max(-1)
    return bool(scaled < NO_CHANGE * flipped)

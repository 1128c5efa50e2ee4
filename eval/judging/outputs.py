"""Check a policy's outputs for common errors of unit, scale and frame.

A policy with a wrong output unit flies as badly as an untrained one. Two checks find common errors.
One uses the size and the mean vertical component of the outputs in flight. The other runs the
policy on a few synthetic observations with a gate to one side, towards which a correct policy
accelerates.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Container, Sequence
from typing import Any

import numpy as np

from eval.effects.interface import GRAVITY
from eval.judging.guard import ActionLimits, Guarded
from eval.logs.faults.vehicle import FOV_LEAST_DEG
from eval.worlds.trial import TrialResult
from policies.block_policy import ROUNDING
from policies.policy import Policy, checked_act
from policies.spec import ACTION_SIZE, STATE_SIZE, ActionSpec, Note, PolicySpec

LIMITED_MOST = 0.05
"""Share of limited actions above which there is a warning."""
UNIT = 1.0 + 1e-6
"""Outputs up to this size are probably those of an action space from -1 to 1."""
UP_MOST = 6.0
"""Above this mean vertical acceleration [m/s^2], outputs probably contain gravity. A decision at
which the vehicle does not climb enters the mean as 0, since even a correct policy commands upwards
while a vehicle with too little thrust sinks."""

LIFT = 3.0
"""If a policy's vertical acceleration is always above this [m/s^2], even towards a gate below, its
outputs probably contain gravity."""
CLEAR = 0.5
"""Smallest difference of outputs between gates on opposite sides that counts [m/s^2]."""
DOMINANT = 1.5
"""If one component of an output answers to an offset by this factor more than the others, it is the
axis of this offset."""
THRUST = (3.0, 40.0)
"""Plausible mean of the commanded thrust per mass [m/s^2]."""
UNIT_FIX = "check the unit of its output"
SCALE_FIX = (
    "export it with the contract (units, scales, frames) of its environment, or set action.scale; "
    "after a very short training this is no fault"
)
"""Advice (with `UNIT_FIX`) for outputs of a wrong scale and of a wrong unit."""
INPUTS = "; or its state or image has other units, signs or order than the contract"
"""Other cause of outputs with a wrong direction or offset."""
GRAVITY_FIX = f"an action is net acceleration: subtract 9.81 along the state's world_z{INPUTS}"
"""Advice for outputs that contain gravity."""
IMAGE_FACTOR, NO_CHANGE = 1.5, 1e-3
"""Factor on a test image; relative change of the output below which it counts as unchanged."""
VEL_B, UP_B, GATE_B = slice(0, 3), slice(3, 6), slice(6, 9)
"""Parts of a state observation (`policies.observation`), in body axes: velocity, the world's z
axis, the next gate's centre."""
ROWS = 3
"""Number of rows with which policy objects are tested."""
ASIDE_M, AHEAD_M, SPEED, STEPS = 2.0, 6.0, 3.0, 10
"""Distances of the test gate to the side and ahead [m], forward speed [m/s], number of steps."""


class Outputs:
    """Statistics of the outputs of the current trial in each of N slots."""

    def __init__(self, slots: int, action: ActionSpec) -> None:
        self._is_acceleration = action.kind == "acceleration"
        self._count = np.zeros(slots, int)
        self._largest, self._up = np.zeros(slots), np.zeros(slots)
        self._faults = np.zeros((slots, 3), int)

    def start(self, slot: int) -> None:
        """Reset the statistics of `slot` for a new trial."""
        self._count[slot], self._largest[slot], self._up[slot] = 0, 0.0, 0.0
        self._faults[slot] = 0

    def add(self, guarded: Guarded, state: np.ndarray) -> None:
        """Add one output of every slot, with its state observation (N, spec.state_size)."""
        self._count += ~guarded.late
        self._largest = np.fmax(self._largest, guarded.largest)
        self._faults += np.stack([guarded.bad, guarded.limited, guarded.late], axis=-1)
        if self._is_acceleration:
            climbs = (state[:, UP_B] * state[:, VEL_B]).sum(-1) > 0.0
            self._up += climbs * (state[:, UP_B] * guarded.action_b).sum(-1)

    def columns(self, slot: int) -> dict[str, Any]:
        """Return the fields of `TrialResult` for the outputs in `slot`."""
        count = int(self._count[slot])
        up = float(self._up[slot]) / count if count and self._is_acceleration else 0.0
        bad, limited, late = map(int, self._faults[slot])
        faults = {"bad_actions": bad, "limited_actions": limited, "late_actions": late}
        largest = float(self._largest[slot])
        return {"decisions": count, "output_max": largest, "action_up": up, **faults}


def action_report(
    results: Sequence[TrialResult], action: ActionSpec, known: Container[str] = ()
) -> dict[str, Any]:
    """Return the shares of limited and bad actions, and warnings except of `known` faults."""
    decisions = sum(row.decisions for row in results)
    if not decisions:
        return {"decisions": 0, "limited": None, "bad": None, "warnings": []}
    limited = sum(row.limited_actions for row in results) / decisions
    bad = sum(row.bad_actions for row in results) / decisions
    warnings = [n for n in _warnings(results, action, limited, bad) if n.fault not in known]
    return {"decisions": decisions, "limited": limited, "bad": bad, "warnings": warnings}


def _scale_advice(action: ActionSpec) -> str:
    """Return advice against scaling an action twice."""
    return "" if action.is_plain else "; scale it once, by the network or by action.scale"


def _warnings(
    results: Sequence[TrialResult], action: ActionSpec, limited: float, bad: float
) -> list[Note]:
    """Return warnings about the outputs in flight."""
    notes, plain = [], action.kind == "acceleration" and action.is_plain
    largest = [row.output_max for row in results]
    if limited > LIMITED_MOST:
        text = f"{limited:.0%} of its actions were limited"
        notes.append(Note("action_limited", text, UNIT_FIX + _scale_advice(action)))
    if bad:
        text = f"{bad:.1%} of its actions were not finite; the last valid one was used"
        notes.append(Note("action_not_finite", text, "check its weights and its normalisation"))
    if plain and 0.0 < max(largest) <= UNIT:
        text = "all its outputs are within -1 to 1 m/s^2 and are probably unscaled"
        notes.append(Note("action_scale", text, SCALE_FIX))
    up = float(np.median([row.action_up for row in results]))
    if plain and up > UP_MOST:
        text = f"its outputs contain gravity: {up:.1f} m/s^2 upwards while it climbs"
        notes.append(Note("action_gravity", text, GRAVITY_FIX))
    return notes


def notes_of(policy: Policy) -> tuple[Note, ...]:
    """Return the notes about a policy before it flies.

    They are the assumptions about its file, and the probable faults of its outputs. An object that
    is from no file has no `notes`: only its rows are tested, by `check_rows`.
    """
    notes = getattr(policy, "notes", None)
    return check_rows(policy) if notes is None else (*notes, *probable_faults(policy))


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
    """Return the probable faults of unit, scale and frame in the policy's camera and outputs."""
    kind, fov_deg = policy.spec.action.kind, policy.spec.camera.fov_deg
    notes: tuple[Note, ...] = ()
    if max(fov_deg) < FOV_LEAST_DEG:
        text = f"{policy.name}: its camera sees only {fov_deg[0]:g} x {fov_deg[1]:g} deg"
        notes = (Note("camera_fov", text, "camera.fov_deg in degrees, not radians"),)
    checks = {"acceleration": _acceleration_faults, "ctbr": _thrust_faults}
    return (*notes, *checks[kind](policy)) if kind in checks else notes


def _thrust_faults(policy: Policy) -> tuple[Note, ...]:
    """Return a note if the mean commanded thrust towards test gates is implausible."""
    thrust = float(probe(policy)[0][:, 0].mean())
    if THRUST[0] <= thrust <= THRUST[1]:
        return ()
    text = f"{policy.name}: commands a thrust of {thrust:.3g} m/s^2 in level flight towards a gate"
    fix = "thrust is per mass [m/s^2], 9.81 in hover, no share and no force; or set action.scale"
    return (Note("action_thrust", text, fix),)


def _acceleration_faults(policy: Policy) -> tuple[Note, ...]:
    """Return the probable faults of an action of kind `acceleration`."""
    name = policy.name
    action, output = probe(policy)
    left, right, above, below, _ = action
    if not np.isfinite(action).all():
        text = f"{name}: outputs NaN or infinity in level flight towards a gate"
        return (Note("action_not_finite", text, "check its weights and its normalisation"),)
    largest = float(np.linalg.norm(action, axis=-1).max())
    if largest > ActionLimits().size:
        text = f"{name}: commands up to {largest:.0f} m/s^2 in level flight, more than the limit"
        return (Note("action_limited", text, UNIT_FIX + _scale_advice(policy.spec.action)),)
    notes = []
    sideways, up = left[1] - right[1], above[2] - below[2]
    if order := _order(left - right, above - below):
        text = f"{name}: accelerates towards gates as if its action were in the order {order}"
        notes.append(Note("action_order", text, "an action is in the order x, y, z" + INPUTS))
    elif sideways < -CLEAR and up < -CLEAR:
        text = (
            f"{name}: accelerates away from gates to the left and above, as if its action were FRD"
        )
        notes.append(Note("action_frame", text, "the suite uses FLU: negate y and z" + INPUTS))
    elif min(sideways, up) < -CLEAR:
        axis, side = ("y", "left") if sideways < up else ("z", "up")
        text = f"{name}: accelerates away from gates offset in {axis}, as if {axis} were negated"
        notes.append(
            Note("action_frame", text, f"the suite's {axis} points {side}: negate it" + INPUTS)
        )
    if action[:, 2].min() > LIFT and not order:
        text = (
            f"{name}: commands at least {action[:, 2].min():.1f} m/s^2 up in level flight, as if "
        )
        notes.append(Note("action_gravity", text + "its action contained gravity", GRAVITY_FIX))
    if not output.any():
        text = f"{name}: outputs exactly 0 for gates far to the side, with no object in its image"
        fix = "look for a condition on its image, whose encoding is in the contract, or dead units"
        notes.append(Note("action_zero", text, fix))
    elif policy.spec.action.is_plain and np.abs(output).max() <= UNIT:
        text = f"{name}: outputs only -1 to 1 m/s^2 for gates far to the side, as if unscaled"
        notes.append(Note("action_scale", text, SCALE_FIX))
    if _divides_images(policy):
        text = f"{name}: has the same output for an image and for {IMAGE_FACTOR:g} times that image"
        fix = "an image without scale contains no distances: do not divide it by its maximum"
        notes.append(Note("image_scale", text, fix))
    return tuple(notes)


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
    outputs = _run(policy, _level_states(spec, np.zeros((len(image), 2))), image)[1][0]
    scaled, flipped = np.abs(outputs[1:] - outputs[0]).max(-1)
    return bool(scaled < NO_CHANGE * flipped)


def probe(policy: Policy) -> tuple[np.ndarray, np.ndarray]:
    """Run a policy on synthetic observations of level flight towards five test gates.

    The gates are to the left, to the right, above, below and straight ahead.

    Returns:
        The last actions (5, size) in SI units, and the outputs of all steps (STEPS, 5, size).
    """
    spec = policy.spec
    offset = ASIDE_M * np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [0, 0]])
    no_object = 0.0 if spec.depth.uint8 else spec.depth.bounds(spec.camera.range_m)[0]
    image = np.full((len(offset), *spec.image_shape), no_object, np.float32)
    return _run(policy, _level_states(spec, offset), image)


def _level_states(spec: PolicySpec, offset: np.ndarray) -> np.ndarray:
    """Return states of level flight with a gate ahead, offset by (N, 2) to the left and up [m]."""
    state = np.zeros((len(offset), spec.state_size), np.float32)
    state[:, VEL_B], state[:, UP_B] = (SPEED, 0, 0), (0, 0, 1)
    state[:, GATE_B] = np.insert(offset, 0, AHEAD_M, axis=1)
    if spec.action.kind == "ctbr":
        state[:, STATE_SIZE - ACTION_SIZE] = GRAVITY  # the last thrust
    next_entry = spec.base_size
    for key, size in (("second_gate", 3), ("gate_axis", 3), ("second_axis", 3)):
        if getattr(spec, key):
            state[:, next_entry : next_entry + size] = (1, 0, 0)
            if key == "second_gate":
                state[:, next_entry : next_entry + 3] = state[:, GATE_B] + (AHEAD_M, 0, 0)
            next_entry += size
    if spec.speed_input:
        state[:, -1] = spec.speed
    return state


def check_rows(policy: Policy) -> tuple[Note, ...]:
    """Refuse a policy object whose answer for a row depends on the other rows.

    A row is the observation of one trial. If possible a copy is tested, so that the object itself
    stays as it is. An object that fails here, as it takes another number of rows, is not tested.

    Returns:
        A note if the same inputs give two answers: the policy is random or keeps memory.

    Raises:
        ValueError: naming the largest change of an answer.
    """
    tested = policy
    with contextlib.suppress(Exception):  # an object that cannot be copied is tested itself
        tested = copy.deepcopy(policy)
    try:
        first, again, other = (_two_answers(tested, ROWS, seed) for seed in (0, 0, 1))
        alone = _two_answers(tested, 1, 0)
    except Exception:  # any error of an object's own code; the judge reports it
        return ()
    if first.shape[1:] != (ROWS, policy.spec.action.size) or first.dtype.kind not in "fiu":
        return ()  # the judge refuses these actions
    if first.tobytes() != again.tobytes():
        text = (
            f"policy {policy.name!r}: the same inputs gave two answers. It is random, or its "
            "memory is in the object, so that results depend on earlier trials"
        )
        return (Note("memory_outside", text, "keep it in hidden"),)
    change = max(np.abs(answers[:, 0] - first[:, 0]).max() for answers in (other, alone))
    if change > ROUNDING * max(1.0, np.abs(first).max()):
        raise ValueError(
            f"policy {policy.name!r}: a row's action changes by {change:.2g} with the other rows "
            "of its batch; rows are separate trials (docs/policies.md)"
        )
    return ()


def _two_answers(policy: Policy, count: int, seed: int) -> np.ndarray:
    """Return two actions (2, count, size) of a policy; the seed changes all rows but the first."""
    spec = policy.spec
    rows = [np.random.default_rng([row, seed if row else 0]) for row in range(count)]
    state = _level_states(spec, ASIDE_M * np.stack([rng.normal(size=2) for rng in rows]))
    state[:, VEL_B] += np.stack([rng.normal(size=3) for rng in rows])
    most = 255.0 if spec.depth.uint8 else 2.0
    image = np.stack([rng.uniform(0.0, most, spec.image_shape) for rng in rows]).astype(np.float32)
    hidden, actions = policy.start(count), []
    for fresh in (True, False):
        flags = np.full(count, fresh)
        action, hidden = checked_act(policy, hidden, state.copy(), image.copy(), flags)
        actions.append(np.asarray(action))
    return np.stack(actions)


def _run(policy: Policy, state: np.ndarray, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Run a policy for STEPS steps; return what `probe` returns, for N rows."""
    spec = policy.spec
    last_action = state[:, STATE_SIZE - ACTION_SIZE : spec.base_size]
    hidden, outputs, action = policy.start(len(state)), [], last_action
    for step in range(STEPS):
        fresh = np.full(len(state), step == 0)
        output, hidden = policy.act(hidden, state, image, fresh)
        outputs.append(output)
        action = np.asarray(spec.action.to_si(output), np.float32)
        norm = np.linalg.norm(action, axis=-1, keepdims=True)
        last_action[:] = action * np.minimum(1.0, ActionLimits().size / np.maximum(norm, 1e-6))
    return np.asarray(action, float), np.array(outputs, float)

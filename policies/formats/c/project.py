"""Export a policy as a folder of C files: policy.h, policy.c, and a test program.

The test program runs on the target processor and compares the policy's outputs with those that were
recorded at the export (vectors.h).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from policies.formats.c.arrays import float_text
from policies.formats.c.forward import Observed
from policies.formats.c.quantised import Quantised, quantise
from policies.formats.c.quantised import actions as quantised_actions
from policies.formats.c.source import TEMPLATES, sources
from policies.formats.policy_file import PolicyCheckpoint
from policies.formats.spec_json import embed
from policies.native import native_policy
from policies.policy import Policy
from policies.spec import PolicyError, PolicySpec
from tracks.common.names import printable

VECTORS = 12
"""Number of successive steps in vectors.h, in which the policy keeps its memory."""
TOLERANCE = {"float32": 1e-4, "int8": 0.05}
"""Type -> largest allowed difference of an action from the recorded action [m/s^2]. If one int8
activation rounds to the neighbouring byte, the action changes by about 0.01 m/s^2."""


class Project(NamedTuple):
    """A policy exported as C."""

    files: dict[str, str]
    """Text of each file, by name."""
    layers: dict[str, Quantised] | None
    """The quantised large layers; None for float32."""


def c_project(
    checkpoint: PolicyCheckpoint,
    name: str,
    dtype: str = "float32",
    observed: Observed | None = None,
) -> Project:
    """Return a policy as C.

    The weights are "float32" or "int8", which requires `observed`, the policy's inputs in recorded
    flights.

    Raises:
        PolicyError: where int8 has no observations.
    """
    params, spec = checkpoint.params, checkpoint.spec
    layers = None
    if dtype == "int8":
        if observed is None or not len(observed.state):
            raise PolicyError(
                f"{name}: int8 needs observations of flights to scale the activations; suite "
                "export flies them, export_policy takes them as `observed`"
            )
        layers = quantise(params, spec, observed)
        name = f"{name}-int8"
    name = printable(name, keep="")  # it is written into comments
    label = embed(spec, name, checkpoint.seed)
    vectors = Observed(*(x[:VECTORS] for x in observed or random_observations(spec, VECTORS)))
    vectors = vectors._replace(fresh=np.arange(len(vectors.state)) == 0)
    if layers is None:
        actions = native_actions(params, spec, vectors)
    else:
        actions = quantised_actions(params, spec, layers, vectors)
    files = {
        **sources(checkpoint, name, label, layers),
        "vectors.h": _vectors(vectors, actions, TOLERANCE[dtype]),
        **{file: (TEMPLATES / file).read_text(encoding="utf-8") for file in _COPIED},
    }
    return Project(files, layers)


def native_actions(
    params: Mapping[str, np.ndarray], spec: PolicySpec, observed: Observed
) -> np.ndarray:
    """Return the actions (T, size) of the policy in JAX for T observations."""
    policy = dataclasses.replace(native_policy(params, spec, "policy"), block=1, rows=1)
    return actions_of(policy, observed)


def actions_of(policy: Policy, observed: Observed) -> np.ndarray:
    """Return a policy's actions (T, size); its memory is cleared where a flight begins."""
    hidden, actions = policy.start(1), []
    for state, image, fresh in zip(*observed, strict=True):
        action, hidden = policy.act(hidden, state[None], image[None], np.array([fresh]))
        actions.append(action[0])
    return np.array(actions, np.float32)


def random_observations(spec: PolicySpec, steps: int, seed: int = 0) -> Observed:
    """Return one flight of random observations, whose magnitudes are as in racing."""
    rng = np.random.default_rng(seed)
    camera, depth = spec.camera, spec.depth
    shape = (steps, camera.height, camera.width)
    depth_m = np.exp(rng.uniform(np.log(depth.near), np.log(camera.range_m), shape))
    return Observed(
        rng.normal(0.0, 2.0, (steps, spec.state_size)).astype(np.float32),
        (depth.scale / depth_m - depth.offset).astype(np.float32),
        np.arange(steps) == 0,
    )


_COPIED = ("main.c", "CMakeLists.txt")
"""Templates that are copied without changes."""
FILES = ("policy.c", "policy.h", "vectors.h", *_COPIED)
"""Names of all files of an export."""


def _vectors(observed: Observed, actions: np.ndarray, tolerance: float) -> str:
    """Return the text of vectors.h: observations, actions and their tolerance."""
    head = (
        "/* Successive observations after policy_reset, and the actions that were exported. */\n"
        f"enum {{ VECTORS = {len(actions)} }};\n#define TOLERANCE {float_text(tolerance)}\n\n"
    )
    tables = (
        ("observations", "POLICY_STATE_SIZE", observed.state),
        ("images", "POLICY_IMAGE_HEIGHT * POLICY_IMAGE_WIDTH", observed.image),
        ("actions", "POLICY_ACTION_SIZE", actions),
    )
    return head + "\n".join(_table(*table) for table in tables)


def _table(name: str, size: str, values: np.ndarray) -> str:
    """Return the C definition of an array with a row for each step."""
    rows = [
        "    {" + ", ".join(float_text(x) for x in np.ravel(row).astype(np.float32).tolist()) + "}"
        for row in values
    ]
    return f"static const float {name}[VECTORS][{size}] = {{\n" + ",\n".join(rows) + "};\n"

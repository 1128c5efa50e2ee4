"""A policy as a folder of C files: policy.h, policy.c, and a test program for the target."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from policies.formats.c.arrays import float_text
from policies.formats.c.forward import Observed
from policies.formats.c.quantised import Quantised, answers, quantise
from policies.formats.c.source import TEMPLATES, sources
from policies.formats.policy_file import PolicyCheckpoint
from policies.formats.spec_json import embed
from policies.native import native_policy
from policies.policy import Policy
from policies.spec import PolicyError, PolicySpec
from tracks.common.names import printable, unknown_name

DTYPES = ("float32", "int8")
VECTORS = 12
"""Steps in vectors.h, with memory."""
TOLERANCE = {"float32": 1e-4, "int8": 0.05}
"""How far an answer may be from the one it was exported with [m/s^2]. A rounding that falls the
other way moves a byte by one, and with 8 bits that is a hundredth of an action."""


class Project(NamedTuple):
    """An export in C."""

    files: dict[str, str]
    """Text by file name."""
    layers: dict[str, Quantised] | None
    """The large layers of 8 bits; None for float32."""


def c_project(
    checkpoint: PolicyCheckpoint,
    name: str,
    dtype: str = "float32",
    observed: Observed | None = None,
) -> Project:
    """Return a policy as C.

    Args:
        checkpoint: the policy.
        name: what it is called.
        dtype: "float32" or "int8".
        observed: what it was given in flights; int8 needs them.

    Raises:
        ValueError: for an unknown type.
        PolicyError: where int8 has no observations.
    """
    if dtype not in DTYPES:
        raise unknown_name("type", dtype, DTYPES)
    params, spec = checkpoint.params, checkpoint.spec
    layers = None
    if dtype == "int8":
        if observed is None or not len(observed.state):
            raise PolicyError(
                f"{name}: int8 needs observations of flights, by which activations are scaled; "
                "suite export flies them, export_policy takes them as `observed`"
            )
        layers = quantise(params, spec, observed)
        name = f"{name}-int8"
    name = printable(name, keep="")  # it is written into comments
    label = embed(spec, name, checkpoint.seed)
    part = Observed(*(x[:VECTORS] for x in observed or drawn(spec, VECTORS)))
    part = part._replace(fresh=np.arange(len(part.state)) == 0)
    if layers is None:
        actions = native_answers(params, spec, part)
    else:
        actions = answers(params, spec, layers, part)
    files = {
        **sources(checkpoint, name, label, layers),
        "vectors.h": _vectors(part, actions, TOLERANCE[dtype]),
        **{each: (TEMPLATES / each).read_text(encoding="utf-8") for each in _AS_THEY_ARE},
    }
    return Project(files, layers)


def native_answers(
    params: Mapping[str, np.ndarray], spec: PolicySpec, observed: Observed
) -> np.ndarray:
    """Return the JAX policy's actions (T, 3) for observations in turn."""
    one = dataclasses.replace(native_policy(params, spec, "policy"), block=1, rows=1)
    return answers_of(one, observed)


def answers_of(policy: Policy, observed: Observed) -> np.ndarray:
    """Return a policy's actions (T, 3), its memory cleared where an observation is fresh."""
    hidden, actions = policy.start(1), []
    for state, image, fresh in zip(*observed, strict=True):
        action, hidden = policy.act(hidden, state[None], image[None], np.array([fresh]))
        actions.append(action[0])
    return np.array(actions, np.float32)


def drawn(spec: PolicySpec, steps: int, seed: int = 0) -> Observed:
    """Return observations drawn at random, of the size that racing has; one flight."""
    rng = np.random.default_rng(seed)
    camera, depth = spec.camera, spec.depth
    size = (steps, camera.height, camera.width)
    metres = np.exp(rng.uniform(np.log(depth.near), np.log(camera.range_m), size))
    return Observed(
        rng.normal(0.0, 2.0, (steps, spec.state_size)).astype(np.float32),
        (depth.scale / metres - depth.offset).astype(np.float32),
        np.arange(steps) == 0,
    )


_AS_THEY_ARE = ("main.c", "CMakeLists.txt")


def _vectors(observed: Observed, actions: np.ndarray, tolerance: float) -> str:
    head = (
        "/* Observations in turn, from policy_reset on, and the actions that were exported. */\n"
        f"enum {{ VECTORS = {len(actions)} }};\n#define TOLERANCE {float_text(tolerance)}\n\n"
    )
    tables = (
        ("observations", "POLICY_STATE_SIZE", observed.state),
        ("images", "POLICY_IMAGE_HEIGHT * POLICY_IMAGE_WIDTH", observed.image),
        ("actions", "POLICY_ACTION_SIZE", actions),
    )
    return head + "\n".join(_table(*each) for each in tables)


def _table(name: str, size: str, values: np.ndarray) -> str:
    rows = [
        "    {" + ", ".join(float_text(x) for x in np.ravel(row).astype(np.float32).tolist()) + "}"
        for row in values
    ]
    return f"static const float {name}[VECTORS][{size}] = {{\n" + ",\n".join(rows) + "};\n"

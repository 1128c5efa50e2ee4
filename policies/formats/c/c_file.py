"""Load a policy.c as a `Policy`: it is compiled, and called row by row in its own process.

A row is the observation of one trial (one judged flight).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np

from policies.formats.c.compiler import compiled_library
from policies.formats.model_process import ANSWER_BYTES, ModelProcess
from policies.formats.spec_json import KEY, extract
from policies.spec import NeedsTrust, Note, PolicyError, PolicySpec

_STATE_MOST = 2**26
"""Largest size of the C struct `policy_state`, the memory of one flight [bytes]."""
_WORD = 4
"""Size of a float32 [bytes]; states are sent to the process as arrays of float32."""


@final
@dataclass(frozen=True)
class CPolicy:
    """A `Policy` around the two functions of policy.h."""

    name: str
    """Name of the policy in tables."""
    spec: PolicySpec
    """The rate, camera and scaling that the policy expects."""
    library: Path
    """Path of the compiled shared library."""
    loaded: ModelProcess
    """The process that has loaded the library."""
    state_bytes: int
    """Size of the C struct `policy_state` [bytes]."""
    notes: tuple[Note, ...] = ()
    """Assumptions about the policy that its file does not state."""

    def start(self, n: int) -> np.ndarray:
        """Return the `policy_state` at the start of n trials, as (n, k) float32 zeros."""
        return np.zeros((n, -(-self.state_bytes // _WORD)), np.float32)

    def act(
        self, hidden: np.ndarray, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the actions (n, spec.action.size) and the new state; see `Policy.act`."""
        actions = np.empty((len(hidden), self.spec.action.size), np.float32)
        next_hidden = np.empty_like(hidden)
        rows_at_once = max(1, ANSWER_BYTES // 2 // max(1, hidden[:1].nbytes))
        for low in range(0, len(hidden), rows_at_once):
            rows = slice(low, low + rows_at_once)
            feed = {"memory": hidden[rows], "fresh": fresh[rows], "state": state[rows]}
            feed |= {"image": image[rows], "action": actions[rows]}
            actions[rows], next_hidden[rows] = self.loaded.run(feed)
        return actions, next_hidden


def load_c(path: Path, trust: bool = False) -> CPolicy:
    """Return the policy of a policy.c, or of a folder with policy.c and policy.h.

    Raises:
        PolicyError: without trust, without a compiler, or where it does not compile, its sizes do
            not fit, the same inputs give different outputs, also after `policy_reset`, or a call
            does not end in time.
    """
    file = path / "policy.c" if path.is_dir() else path
    if not trust:
        raise NeedsTrust(
            f"{file}: C is compiled and run on this machine and can do anything; if you trust its "
            "author, pass --trust (in Python trust=True); as .onnx, a policy can be shared "
            "without trust"
        )
    library = compiled_library(file)
    loaded = ModelProcess(str(library).encode(), str(file), "library", (KEY,))
    (state_bytes, *sizes), text = loaded.sizes, loaded.labels[KEY]
    metadata = extract(loaded.labels, str(file))
    spec = metadata.spec
    expected = [spec.state_size, spec.camera.height, spec.camera.width, spec.action.size]
    sizes[3] = sizes[3] or spec.action.size  # 0: the header does not define it
    if sizes != expected or not 0 < state_bytes <= _STATE_MOST:
        raise PolicyError(
            f"{file}: POLICY_STATE_SIZE, _IMAGE_HEIGHT, _IMAGE_WIDTH and _ACTION_SIZE are {sizes}, "
            f"and a state has {state_bytes} bytes; expected by its POLICY_JSON are {expected} and "
            f"up to {_STATE_MOST} bytes; export it again"
        )
    name = (json.loads(text).get("name") if text else None) or file.stem
    policy = CPolicy(f"{name}.c", spec, library, loaded, state_bytes, metadata.notes)
    _refuse_other_memory(policy, file)
    return policy


def _refuse_other_memory(policy: CPolicy, file: Path) -> None:
    """Refuse code with memory outside the `policy_state`, or that `policy_reset` does not clear."""
    rng = np.random.default_rng(0)
    spec, copies = policy.spec, 3
    hidden = policy.start(copies)
    states = np.repeat(rng.normal(size=(3, 1, spec.state_size)), copies, 1)
    images = np.repeat(rng.normal(size=(3, 1, *spec.image_shape)), copies, 1)
    answers = []
    for step in (0, 1, 2, 0):  # the second flight begins with the inputs of the first
        fresh = np.full(copies, step == 0)
        action, hidden = policy.act(hidden, states[step], images[step], fresh)
        if any(row.tobytes() != action[0].tobytes() for row in action):
            raise PolicyError(
                f"{file}: the same inputs gave two answers; keep all memory of the policy in "
                "policy_state"
            )
        answers.append(action)
    if answers[0].tobytes() != answers[-1].tobytes():
        raise PolicyError(
            f"{file}: after policy_reset its answer still depends on the flight before; set every "
            "field of policy_state there"
        )

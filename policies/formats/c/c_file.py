"""policy.c as `Policy`: compiled, and called row by row in its own process."""

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
"""Bytes of one flight's `policy_state`."""
_WORD = 4
"""Bytes; memories travel in whole ones."""


@final
@dataclass(frozen=True)
class CPolicy:
    """A `Policy` around the two functions of policy.h."""

    name: str
    """Its label in tables."""
    spec: PolicySpec
    """The rate, camera and scaling it expects of the world."""
    library: Path
    """The shared library."""
    loaded: ModelProcess
    """It, in its process."""
    state_bytes: int
    """Size of `policy_state`."""
    notes: tuple[Note, ...] = ()
    """Assumptions about it, as sentences."""

    def start(self, n: int) -> np.ndarray:
        """Return the `policy_state` of n trials, reset: its bytes as (n, k) float32 words."""
        return np.zeros((n, -(-self.state_bytes // _WORD)), np.float32)

    def act(
        self, hidden: np.ndarray, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (action (n, spec.action.size), hidden'); see `policies.policy.Policy.act`."""
        actions = np.empty((len(hidden), self.spec.action.size), np.float32)
        after = np.empty_like(hidden)
        most = max(1, ANSWER_BYTES // 2 // max(1, hidden[:1].nbytes))
        for low in range(0, len(hidden), most):
            rows = slice(low, low + most)
            feed = {"memory": hidden[rows], "fresh": fresh[rows], "state": state[rows]}
            feed |= {"image": image[rows], "action": actions[rows]}
            actions[rows], after[rows] = self.loaded.run(feed)
        return actions, after


def load_c(path: Path, trust: bool = False) -> CPolicy:
    """Return the policy of a policy.c, or of a folder with one and its policy.h.

    Raises:
        PolicyError: without trust, without a compiler, or where it does not compile, its sizes do
            not fit, the same inputs give two answers, or it does not come to an end.
    """
    file = path / "policy.c" if path.is_dir() else path
    if not trust:
        raise NeedsTrust(
            f"{file}: C is compiled and run on this machine and can do anything; if you trust who "
            "made the file, pass --trust; a policy to be shared needs none as .onnx"
        )
    library = compiled_library(file)
    loaded = ModelProcess(str(library).encode(), str(file), "library", (KEY,))
    (state_bytes, *sizes), text = loaded.sizes, loaded.labels[KEY]
    metadata = extract(loaded.labels, str(file))
    spec = metadata.spec
    expected = [spec.state_size, spec.camera.height, spec.camera.width]
    if sizes != expected or not 0 < state_bytes <= _STATE_MOST:
        raise PolicyError(
            f"{file}: POLICY_STATE_SIZE, POLICY_IMAGE_HEIGHT and POLICY_IMAGE_WIDTH are {sizes}, "
            f"and a state has {state_bytes} bytes; expected by its POLICY_JSON are {expected} and "
            f"up to {_STATE_MOST} bytes; export it again"
        )
    named = json.loads(text).get("name") if text else None
    policy = CPolicy(f"{named or file.stem}.c", spec, library, loaded, state_bytes, metadata.notes)
    return _proven(policy, file)


def _proven(policy: CPolicy, file: Path) -> CPolicy:
    """Refuse code with global state: equal inputs must give equal outputs."""
    rng = np.random.default_rng(0)
    spec, n = policy.spec, 3
    hidden, fresh = policy.start(n), np.ones(n, bool)
    for _ in range(3):
        state = np.repeat(rng.normal(size=(1, spec.state_size)), n, 0)
        image = np.repeat(rng.normal(size=(1, *spec.image_shape)), n, 0)
        action, hidden = policy.act(hidden, state, image, fresh)
        if any(row.tobytes() != action[0].tobytes() for row in action):
            raise PolicyError(
                f"{file}: the same inputs gave two answers; all that a policy remembers belongs "
                "into policy_state"
            )
        fresh = np.zeros(n, bool)
    return policy

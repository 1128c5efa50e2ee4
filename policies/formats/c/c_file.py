"""policy.c as `Policy`: compiled and called in this process, one row after another."""

from __future__ import annotations

import ctypes
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from policies.errors import PolicyError
from policies.formats.c.compiler import compiled_library
from policies.formats.embedded_spec import extract
from policies.spec import ACTION_SIZE, PolicySpec

_STATE_MOST = 2**26
"""Bytes of one flight's `policy_state`."""


@final
@dataclass(frozen=True)
class CPolicy:
    """A `Policy` around the two functions of policy.h."""

    name: str
    """What tables call it."""
    spec: PolicySpec
    """The rate, camera and scaling it expects of the world."""
    library: Any
    """The loaded library."""
    state_bytes: int
    """Size of `policy_state`."""

    def start(self, n: int) -> np.ndarray:
        """Return the `policy_state` of n trials, reset: (n, state_bytes) bytes."""
        return np.zeros((n, self.state_bytes), np.uint8)

    def act(
        self, hidden: np.ndarray, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (action_b (n, 3) [m/s^2], hidden'); see `policies.policy.Policy.act`."""
        after = np.array(hidden, np.uint8, order="C")
        actions = np.empty((len(after), ACTION_SIZE), np.float32)
        inputs = [np.ascontiguousarray(x, np.float32) for x in (state, image)]
        begins = np.ascontiguousarray(fresh, np.uint8)
        arrays = (after, begins, *inputs, actions)
        self.library.suite_rows(len(after), *(ctypes.c_void_p(x.ctypes.data) for x in arrays))
        return actions, after


def load_c(path: Path, trust: bool = False) -> CPolicy:
    """Return the policy of a policy.c, or of a folder with one and its policy.h.

    Raises:
        PolicyError: without trust, without a compiler, or where it does not compile, its sizes do
            not fit, or the same inputs give two answers.
    """
    file = path / "policy.c" if path.is_dir() else path
    if not trust:
        raise PolicyError(
            f"{file}: C is compiled and run on this machine and can do anything; if you trust who "
            "made the file, pass --trust; a policy to be shared needs none as .onnx"
        )
    library = ctypes.CDLL(str(compiled_library(file)))
    library.suite_json.restype = ctypes.c_char_p
    state_bytes, *sizes = (library.suite_size(k) for k in range(4))
    text = library.suite_json().decode(errors="replace")
    spec = extract(text, str(file))
    expected = [spec.state_size, spec.camera.height, spec.camera.width]
    if sizes != expected or not 0 < state_bytes <= _STATE_MOST:
        raise PolicyError(
            f"{file}: POLICY_STATE_SIZE, POLICY_IMAGE_HEIGHT and POLICY_IMAGE_WIDTH are {sizes}, "
            f"and a state has {state_bytes} bytes; expected by its POLICY_JSON are {expected} and "
            f"up to {_STATE_MOST} bytes; export it again"
        )
    named = json.loads(text).get("name") if text else None
    return _proven(CPolicy(f"{named or file.stem}.c", spec, library, state_bytes), file)


def _proven(policy: CPolicy, file: Path) -> CPolicy:
    """Refuse what keeps a memory of its own: rows that are given the same must answer alike."""
    rng = np.random.default_rng(0)
    spec, n = policy.spec, 3
    hidden, fresh = policy.start(n), np.ones(n, bool)
    for _ in range(3):
        state = np.repeat(rng.normal(size=(1, spec.state_size)), n, 0)
        image = np.repeat(rng.normal(size=(1, spec.camera.height, spec.camera.width)), n, 0)
        action, hidden = policy.act(hidden, state, image, fresh)
        if any(row.tobytes() != action[0].tobytes() for row in action):
            raise PolicyError(
                f"{file}: the same inputs gave two answers; all that a policy remembers belongs "
                "into policy_state"
            )
        fresh = np.zeros(n, bool)
    return policy

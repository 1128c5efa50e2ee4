"""The `Policy` protocol, and `load_policy`, which loads a policy by name or from a file.

A policy maps an observation (state vector and depth image) to an action. The judge, which flies
policies in simulation and scores them, uses policies through this protocol only.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from policies import shipped
from policies.spec import PolicyError, PolicySpec, check_spec
from tracks.common.names import closest, unknown_name
from tracks.input.ranges import as_path, check_type, shown

Hidden = Any
"""Hidden state (memory) of a policy for n trials; only the policy reads it."""

SUFFIXES = {
    ".onnx": "ONNX",
    ".pt2": "torch exported program, needs trust",
    ".pt": "TorchScript, needs trust",
    ".c": "C with policy.h in its folder, needs trust and a C compiler",
}
"""Kinds of policy file by suffix; a folder is a checkpoint of the suite, or contains policy.c."""


class Policy(Protocol):
    """Computes actions for n trials (flights) at once, one a row.

    The outputs of a row depend on the inputs of that row only, to the bit.
    """

    @property
    def name(self) -> str:
        """Name of the policy in tables."""
        ...

    @property
    def spec(self) -> PolicySpec:
        """The rate, camera and scaling that the policy expects."""
        ...

    def start(self, n: int) -> Hidden:
        """Return the hidden state at the start of n trials."""
        ...

    def act(
        self, hidden: Hidden, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, Hidden]:
        """Return the actions for one observation of n trials.

        Args:
            hidden: hidden state, from `start` or the last `act`.
            state: (n, spec.state_size) the state of `observation.observe`, float32.
            image: (n, height, width) the image of `observation.observe`, float32.
            fresh: (n,) bool, rows in which a new trial starts; their hidden state is reset first.

        Returns:
            The actions (n, spec.action.size) float32, unchecked (by default the wanted net
            acceleration in current body axes [m/s^2]), and the new hidden state.
        """
        ...


MEMBERS: dict[str, tuple[Any, str]] = {
    "name": (str, "a text"),
    "spec": (PolicySpec, "a policies.spec.PolicySpec"),
    "start": (Callable, "a method"),
    "act": (Callable, "a method"),
}
"""Member of a policy -> its type, and the type's name in messages."""


def check_is_policy(policy: Any) -> None:
    """Refuse an object that is no policy.

    Raises:
        ValueError: naming its missing or wrong members, or an invalid number of its spec.
    """
    about = (
        "a policy object has name, spec, start(n) and act(hidden, state, image, fresh): "
        "docs/policies.md"
    )
    if isinstance(policy, type):
        raise PolicyError(f"policy {policy.__name__} is a class; give an object, such as "
                          f"{policy.__name__}(); {about}")  # fmt: skip
    if missing := [name for name in MEMBERS if not hasattr(policy, name)]:
        raise ValueError(f"policy {shown(policy)} has no {', '.join(missing)}; {about}")
    for name, (kind, text) in MEMBERS.items():
        value = getattr(policy, name)
        if not isinstance(value, kind):
            raise ValueError(
                f"policy {shown(policy)}: its {name} is {shown(value)}, not {text}; {about}"
            )
    for name, arguments in (("start", 1), ("act", 4)):
        try:
            signature = inspect.signature(getattr(policy, name))
        except ValueError:  # as of a function in C
            continue
        try:
            signature.bind(*range(arguments))
        except TypeError as error:
            raise PolicyError(
                f"policy {policy.name!r}: its {name}{signature} takes other arguments ({error}); "
                f"{about}"
            ) from None
    check_spec(policy.spec, f"policy {policy.name!r}: spec.")


def checked_act(
    policy: Policy, hidden: Hidden, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
) -> tuple[np.ndarray, Hidden]:
    """Return what `Policy.act` returns; its actions are unchecked.

    The policy gets copies of `state` and `image`, as it may write into them.

    Raises:
        ValueError: where that is not a tuple of two, or the action is a tensor with a gradient.
    """
    output = policy.act(hidden, state.copy(), image.copy(), fresh)
    if not isinstance(output, tuple) or len(output) != 2:
        kind = f"{len(output)} values" if isinstance(output, tuple) else type(output).__name__
        raise ValueError(
            f"policy {policy.name!r}: act returned {kind}, expected the tuple (action, hidden)"
        )
    if getattr(output[0], "requires_grad", False):
        raise ValueError(
            f"policy {policy.name!r}: act returned a torch tensor with a gradient; call the "
            "network under torch.no_grad(), and return action.numpy()"
        )
    return output


class Wrapper:
    """A `Policy` that flies as another `policy` does; a subclass adds something to `act`."""

    def __init__(self, policy: Policy) -> None:
        """Take name, spec and memory from `policy`."""
        self.policy, self.name, self.spec = policy, policy.name, policy.spec
        self.start = policy.start

    def act(
        self, hidden: Hidden, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, Hidden]:
        """Return what `checked_act` returns for the policy."""
        return checked_act(self.policy, hidden, state, image, fresh)


def load_policy(name_or_path: str | Path, trust: bool = False) -> Policy:
    """Return a policy to fly.

    Args:
        name_or_path: the name of a shipped policy, a checkpoint's folder, or a file: .onnx, .pt2
            (torch exported program), .pt (TorchScript), policy.c or its folder.
        trust: also load .pt2, .pt and .c, which can run any code on this machine. The suite's
            checkpoints and ONNX files with standard operators need no trust.

    Raises:
        PolicyError: for an unknown name, or a file that cannot be used or is not safe; the message
            says why and what to do.
    """
    path = as_path("policy", name_or_path, "a name, as a text, or a path")
    check_type("trust", trust, (bool,), "True or False")
    text = os.fspath(name_or_path)
    if text in shipped.names():
        from policies.native import load_native

        return load_native(shipped.locate(text), text)
    if path.suffix == ".c" and path.is_file() or _is_c_folder(path):
        from policies.formats.c.c_file import load_c

        return load_c(path, trust)
    if path.is_dir():
        from policies.native import load_native

        _check_is_checkpoint(path)
        folder = path.resolve()
        # A training writes its policy to RUN/policy, which is named after RUN.
        return load_native(path, folder.parent.name if folder.name == "policy" else folder.name)
    if not path.exists():
        raise _missing(text, path)
    if path.suffix == ".onnx":
        from policies.formats.onnx_file import load_onnx

        return load_onnx(path)
    if path.suffix == ".pt2":
        from policies.formats.torch_file import load_program

        return load_program(path, trust)
    if path.suffix == ".pt":
        from policies.formats.torch_file import load_script

        return load_script(path, trust)
    kinds = ", ".join(f"{suffix} ({kind})" for suffix, kind in SUFFIXES.items())
    in_checkpoint = path.name in ("weights.safetensors", "config.json")
    hint = "export it (docs/policies.md)"
    hint = f"give its folder instead: {path.parent}" if in_checkpoint else hint
    raise PolicyError(
        f"{path}: not a policy file; allowed are a checkpoint's folder, {kinds}; {hint}"
    )


def _check_is_checkpoint(path: Path) -> None:
    """Refuse a folder that is no checkpoint but contains policy files, and name these."""
    names = sorted(each.name for each in path.iterdir() if each.suffix in SUFFIXES)
    if names and not (path / "config.json").exists():
        raise PolicyError(f"{path}: no checkpoint, but a folder with {', '.join(names)}; name one")


def _is_c_folder(path: Path) -> bool:
    return (path / "policy.c").is_file() and not (path / "config.json").exists()


def _missing(text: str, path: Path) -> PolicyError:
    """Return the error for a name or path that does not exist."""
    looks_like_path = len(path.parts) > 1 or path.suffix in SUFFIXES
    if not looks_like_path:
        error = unknown_name("policy", text, shipped.names())
        hint = "A checkpoint's folder or a policy file is allowed as well."
        if "," in text:
            hint = "For several policies give --policy once for each."
        return PolicyError(f"{error} {hint}")
    siblings = [entry.name for entry in path.parent.iterdir()] if path.parent.is_dir() else []
    similar = closest(path.name, siblings)
    question = f" Did you mean {path.parent / similar}?" if similar else ""
    return PolicyError(f"{path}: no such file or folder.{question}")

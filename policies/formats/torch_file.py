"""Torch exported programs (.pt2) and TorchScript (.pt) as `Policy`, run in a process of their own.

Neither is loaded without trust: `torch.jit.load` runs what a file says by design, and
`torch.export.load` unpickles sample inputs and some weights, resolves operators by dotted paths and
evaluates expressions, all from the file; torch has no safe mode for it. The process of their own
(`apart_process.py`) keeps a module that hangs or aborts from taking the suite along, no more.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from policies.block_policy import BlockPolicy, Model, proven
from policies.formats.apart_process import Apart
from policies.formats.program_inputs import INPUTS, check_inputs, inputs_message
from policies.formats.spec_json import KEY, extract
from policies.spec import ACTION_SIZE, NeedsTrust, PolicyError
from tracks.input.reading import MODEL_BYTES, InputError, read_bytes, reason


def load_program(path: Path, trust: bool = False) -> BlockPolicy:
    """Return the policy of a torch exported program.

    Raises:
        PolicyError: without trust, or where the file is damaged or its inputs and outputs do not
            fit.
    """
    loaded = _loaded(path, "program", "a torch exported program", trust)
    spec = extract(loaded.label, str(path))
    shapes = {port.name: port.shape for port in loaded.inputs}
    block, hidden_shape = check_inputs(shapes, spec, str(path))
    model = _as_model(loaded, path, hidden_shape)
    return proven(BlockPolicy(path.name, spec, model, hidden_shape, block, block), str(path))


def load_script(path: Path, trust: bool = False) -> BlockPolicy:
    """Return the policy of a TorchScript file.

    Raises:
        PolicyError: without trust, or where it is no TorchScript or its inputs and outputs do not
            fit.
    """
    loaded = _loaded(path, "script", "TorchScript", trust)
    spec = extract(loaded.label, str(path))
    names = tuple(port.name for port in loaded.inputs)
    if names not in (INPUTS, INPUTS[:2]):
        raise PolicyError(inputs_message(str(path), names))
    hidden_shape = (spec.hidden_size,) if names == INPUTS else (0,)
    model = _as_model(loaded, path, hidden_shape)
    return proven(BlockPolicy(path.name, spec, model, hidden_shape), str(path))


def _loaded(path: Path, kind: str, words: str, trust: bool) -> Apart:
    if not trust:
        raise NeedsTrust(
            f"{path}: {words} can run any code of its maker's while torch loads it; if you trust "
            "who made the file, pass --trust; a policy to be shared needs none as .onnx "
            "(torch.onnx.export; suite export for one of ours)"
        )
    try:
        data = read_bytes(path, MODEL_BYTES)
    except InputError as error:
        raise PolicyError(str(error)) from None
    except OSError as error:
        raise PolicyError(f"{path}: cannot be read ({reason(error)}); check the file") from None
    return Apart(data, str(path), kind, KEY)


def _as_model(loaded: Apart, path: Path, hidden_shape: tuple[int, ...]) -> Model:
    memory = hidden_shape != (0,)

    def model(
        state: np.ndarray, image: np.ndarray, hidden: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        feed = {"state": state, "image": image}
        outputs = loaded.run({**feed, "hidden": hidden} if memory else feed)
        if len(outputs) != 1 + memory:
            raise PolicyError(
                f"{path}: gives {len(outputs)} outputs, expected the tensors action (batch, "
                f"{ACTION_SIZE}){' and hidden' if memory else ''}; see docs/policies.md"
            )
        action, *after = outputs
        return action, after[0] if memory else hidden

    return model

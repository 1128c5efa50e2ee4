"""Load torch exported programs (.pt2) and TorchScript (.pt) as `Policy`, run in a separate process.

Neither is loaded unless the user trusts the file, because loading can run any code:
`torch.jit.load` runs code of the file by design. `torch.export.load` unpickles sample inputs and
some weights, resolves operators by dotted paths and evaluates expressions, all from the file; torch
has no safe mode for it. The separate process (`model_process.py`) only protects the suite from a
module that hangs or crashes.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from policies import contract
from policies.block_policy import BlockPolicy, Model, verify_rows
from policies.formats.model_process import ModelProcess
from policies.formats.program_inputs import INPUTS, check_inputs, check_memory, inputs_message
from policies.formats.spec_json import KEY, extract
from policies.spec import NeedsTrust, PolicyError
from tracks.input.reading import MODEL_BYTES, InputError, read_bytes, reason


def load_program(path: Path, trust: bool = False) -> BlockPolicy:
    """Return the policy of a torch exported program.

    Raises:
        PolicyError: without trust, or where the file is damaged or its inputs and outputs do not
            fit.
    """
    loaded = _loaded(path, "program", "a torch exported program", trust)
    metadata = extract(loaded.labels, str(path))
    spec, shapes = metadata.spec, {port.name: port.shape for port in loaded.inputs}
    _check_names(path, tuple(shapes))
    block, hidden_shape = check_inputs(shapes, spec, str(path))
    check_memory(metadata, hidden_shape, str(path))
    model = _as_model(loaded, path, hidden_shape)
    policy = BlockPolicy(path.name, spec, model, hidden_shape, block, block, metadata.notes)
    return verify_rows(policy, str(path))


def load_script(path: Path, trust: bool = False) -> BlockPolicy:
    """Return the policy of a TorchScript file.

    Raises:
        PolicyError: without trust, or where the file is not TorchScript or its inputs and outputs
            do not fit.
    """
    loaded = _loaded(path, "script", "TorchScript", trust)
    metadata = extract(loaded.labels, str(path))
    spec, names = metadata.spec, tuple(port.name for port in loaded.inputs)
    _check_names(path, names)
    hidden_shape = (spec.hidden_size,) if names == INPUTS else (0,)
    model = _as_model(loaded, path, hidden_shape)
    return verify_rows(
        BlockPolicy(path.name, spec, model, hidden_shape, notes=metadata.notes), str(path)
    )


def _loaded(path: Path, kind: str, words: str, trust: bool) -> ModelProcess:
    """Return a process that has loaded the file; `words` is the file's kind in messages."""
    if not trust:
        raise NeedsTrust(
            f"{path}: {words} can run any code of its author while torch loads it; if you trust "
            "the author, pass --trust; as .onnx, a policy can be shared without trust "
            "(torch.onnx.export; suite export for a policy of the suite)"
        )
    try:
        data = read_bytes(path, MODEL_BYTES)
    except InputError as error:
        raise PolicyError(str(error)) from None
    except OSError as error:
        raise PolicyError(f"{path}: cannot be read ({reason(error)}); check the file") from None
    if kind == "script" and _is_weights(data):
        raise PolicyError(
            f"{path}: this file contains weights without a program (a state_dict or a pickled "
            "module); load them into the module and export that, as in examples/sb3_race.py"
        )
    return ModelProcess(data, str(path), kind, (KEY, contract.KEY))


def _check_names(path: Path, names: tuple[str, ...]) -> None:
    if names not in (INPUTS, INPUTS[:2]):
        raise PolicyError(inputs_message(str(path), names))


def _is_weights(data: bytes) -> bool:
    """Return whether a torch archive is from torch.save, which stores no code."""
    try:
        names = zipfile.ZipFile(io.BytesIO(data)).namelist()
    except zipfile.BadZipFile:
        return False
    pickled = any(name.endswith("data.pkl") for name in names)
    return pickled and not any("/code/" in name for name in names)


def _as_model(loaded: ModelProcess, path: Path, hidden_shape: tuple[int, ...]) -> Model:
    """Return the function that runs the process's model; it checks the number of outputs."""
    has_memory = hidden_shape != (0,)

    def model(
        state: np.ndarray, image: np.ndarray, hidden: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        feed = {"state": state, "image": image}
        outputs = loaded.run({**feed, "hidden": hidden} if has_memory else feed)
        if len(outputs) != 1 + has_memory:
            raise PolicyError(
                f"{path}: gives {len(outputs)} outputs, expected the tensors action"
                f"{' and hidden' if has_memory else ''}; see docs/policies.md"
            )
        action, *next_hidden = outputs
        return action, next_hidden[0] if has_memory else hidden

    return model

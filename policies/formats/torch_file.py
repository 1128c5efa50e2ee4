"""Load torch exported programs (.pt2) and TorchScript (.pt) as `Policy`, run in a separate process.

Neither is loaded unless the user trusts the file, because loading can run any code:
`torch.jit.load` runs code of the file by design. `torch.export.load` unpickles sample inputs and
some weights, resolves operators by dotted paths and evaluates expressions, all from the file; torch
has no safe mode for it. The separate process (`model_process.py`) only protects the suite from a
module that hangs or crashes.
"""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path

from policies import contract
from policies.block_policy import BlockPolicy
from policies.formats.model_process import ModelProcess
from policies.formats.program_inputs import (
    INPUTS,
    described_policy,
    inputs_message,
    program_policy,
    read_model,
)
from policies.formats.spec_json import KEY, extract
from policies.spec import HIDDEN_MOST, NeedsTrust, NoAnswer, PolicyError

FORMATS = {"program": ("a torch exported program", ".pt2"), "script": ("TorchScript", ".pt")}
"""Kind of torch file -> its name in messages, and its suffix."""


def load_program(path: Path, trust: bool = False) -> BlockPolicy:
    """Return the policy of a torch exported program.

    Raises:
        PolicyError: without trust, or where the file is damaged or its inputs and outputs do not
            fit.
    """
    loaded = _loaded(path, "program", trust)
    metadata = extract(loaded.labels, str(path))
    _check_names(path, loaded)
    return described_policy(loaded, path, metadata)


def load_script(path: Path, trust: bool = False) -> BlockPolicy:
    """Return the policy of a TorchScript file.

    Raises:
        PolicyError: without trust, or where the file is not TorchScript or its inputs and outputs
            do not fit.
    """
    loaded = _loaded(path, "script", trust)
    metadata = extract(loaded.labels, str(path))
    names = _check_names(path, loaded)
    # A script does not store the shape of its hidden state.
    memory = metadata.contract.memory if metadata.contract else None
    hidden_shape = (memory or (metadata.spec.hidden_size,)) if names == INPUTS else (0,)
    if math.prod(hidden_shape) > HIDDEN_MOST:
        raise PolicyError(
            f"{path}: its contract says a memory of shape {list(hidden_shape)}, allowed are up to "
            f"{HIDDEN_MOST} numbers; use a smaller memory"
        )
    try:
        return program_policy(loaded, path, metadata, hidden_shape)
    except NoAnswer as error:
        if names != INPUTS or memory:
            raise
        raise PolicyError(
            f"{error}. It was given a hidden of {hidden_shape[0]} numbers; set hidden_size in the "
            f"spec of {KEY} if it has another size"
        ) from None


def _loaded(path: Path, kind: str, trust: bool) -> ModelProcess:
    """Return a process that has loaded the file, which should be of `kind`."""
    if not trust:
        raise NeedsTrust(
            f"{path}: {FORMATS[kind][0]} can run any code of its author while torch loads it; if "
            "you trust the author, pass --trust (in Python trust=True); as .onnx, a policy can be "
            "shared without trust (torch.onnx.export; suite export for a policy of the suite)"
        )
    data = read_model(path)
    found = _kind(data)
    if found == "weights":
        raise PolicyError(
            f"{path}: this file contains weights without a program (a state_dict or a pickled "
            "module); load them into the module and export that, as in examples/sb3_race.py"
        )
    if found not in ("", kind):
        (expected, _), (name, suffix) = FORMATS[kind], FORMATS[found]
        raise PolicyError(
            f"{path}: the suffix {path.suffix} is for {expected}, but this file is {name}; rename "
            f"it to {path.stem}{suffix}"
        )
    return ModelProcess(data, str(path), kind, (KEY, contract.KEY))


def _check_names(path: Path, loaded: ModelProcess) -> tuple[str, ...]:
    """Return the names of a program's inputs; refuse others than a policy's."""
    names = tuple(port.name for port in loaded.inputs)
    if names not in (INPUTS, INPUTS[:2]):
        raise PolicyError(inputs_message(str(path), names))
    return names


def _kind(data: bytes) -> str:
    """Return the kind of a torch archive: program, script or weights; "" for another file."""
    try:
        names = zipfile.ZipFile(io.BytesIO(data)).namelist()
    except zipfile.BadZipFile:
        return ""
    if any(name.endswith(("archive_format", "serialized_exported_program.json")) for name in names):
        return "program"
    if any("/code/" in name for name in names):
        return "script"
    # An archive from torch.save stores no code.
    return "weights" if any(name.endswith("data.pkl") for name in names) else ""

"""Check the inputs of a policy file that was made outside the suite, and make its policy."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from policies.block_policy import BLOCK, BlockPolicy, verify_rows
from policies.formats.model_process import ModelProcess
from policies.formats.spec_json import KEY, PolicyMetadata
from policies.spec import EXTRAS, HIDDEN_MOST, Note, PolicyError, PolicySpec
from tracks.input.reading import MODEL_BYTES, InputError, read_bytes, reason

INPUTS = ("state", "image", "hidden")
"""Names of a program's inputs, in order; a policy without memory omits the last."""
BLOCK_MOST = 4096
"""Largest batch size of a model whose batch size is fixed."""


def read_model(path: Path) -> bytes:
    """Return the contents of a model's file.

    Raises:
        PolicyError: where it cannot be read, or is too large.
    """
    try:
        return read_bytes(path, MODEL_BYTES)
    except InputError as error:
        raise PolicyError(str(error)) from None
    except OSError as error:
        raise PolicyError(f"{path}: cannot be read ({reason(error)}); check the file") from None


def check_inputs(
    shapes: dict[str, tuple[Any, ...]], spec: PolicySpec, where: str
) -> tuple[int, tuple[int, ...]]:
    """Return the number of rows of a block, and the shape of a row's hidden state, of a program.

    Shapes are by name; a size that is not an int is free.

    Raises:
        PolicyError: where names, ranks or sizes are not those of an observation.
    """
    if not shapes or not set(shapes) <= set(INPUTS):
        raise PolicyError(inputs_message(where, tuple(shapes)))
    batch_sizes = {shape[0] for shape in shapes.values() if shape and isinstance(shape[0], int)}
    block = batch_sizes.pop() if batch_sizes else BLOCK
    hidden = shapes.get("hidden", (None, 0))[1:]
    if batch_sizes or not hidden or not all(isinstance(size, int) for size in hidden):
        raise PolicyError(
            f"{where}: inputs have shapes {shapes}; the first axis of each must be the batch, and "
            "the other axes of 'hidden' must have fixed sizes"
        )
    if not 1 <= block <= BLOCK_MOST or not 0 <= math.prod(hidden) <= HIDDEN_MOST:
        raise PolicyError(
            f"{where}: inputs have shapes {shapes}; allowed are batches of 1 to {BLOCK_MOST} rows "
            f"and up to {HIDDEN_MOST} numbers in 'hidden'"
        )
    for name, expected in (("state", (spec.state_size,)), ("image", spec.image_shape)):
        if name not in shapes:
            continue
        shape = shapes[name][1:]
        fits = len(shape) == len(expected) and all(
            size == required or not isinstance(size, int)
            for size, required in zip(shape, expected, strict=True)
        )
        if not fits:
            raise PolicyError(
                f"{where}: input {name!r} has shape {shapes[name]}, expected (batch, "
                f"{', '.join(map(str, expected))}); set the camera's size, {', '.join(EXTRAS)} "
                f"and the kind of action in {KEY} or in its contract; the state's last action has "
                f"{spec.action.size} numbers with the kind {spec.action.kind}"
            )
    return block, tuple(hidden)


def described_policy(loaded: ModelProcess, path: Path, metadata: PolicyMetadata) -> BlockPolicy:
    """Return the policy of a loaded program that describes the shapes of its inputs.

    Raises:
        PolicyError: where inputs or outputs are not those of a policy or of its contract.
    """
    shapes = {port.name: port.shape for port in loaded.inputs}
    block, hidden_shape = check_inputs(shapes, metadata.spec, str(path))
    return program_policy(loaded, path, metadata, hidden_shape, block)


def program_policy(
    loaded: ModelProcess,
    path: Path,
    metadata: PolicyMetadata,
    hidden_shape: tuple[int, ...],
    block: int = BLOCK,
) -> BlockPolicy:
    """Return the policy of a loaded program, which runs `block` rows in each call.

    `hidden_shape` is the shape of a row's hidden state; (0,) for a program without one.

    Raises:
        PolicyError: where the outputs are not the action, and the hidden state if there is one, or
            the hidden state is not that of the contract.
    """
    names = [port.name for port in loaded.inputs]
    has_memory = hidden_shape != (0,)
    memory = metadata.contract.memory if metadata.contract else None
    if memory is not None and memory != (hidden_shape if has_memory else ()):
        raise PolicyError(
            f"{path}: its contract says a memory of shape {list(memory)}, its input 'hidden' has "
            f"{list(hidden_shape)}; export the policy again with its own contract"
        )

    def model(
        state: np.ndarray, image: np.ndarray, hidden: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        feed = {"state": state, "image": image, "hidden": hidden}
        outputs = loaded.run({name: feed[name] for name in names})
        if len(outputs) != 1 + has_memory:
            raise PolicyError(
                f"{path}: gives {len(outputs)} outputs, expected the tensors action"
                f"{' and hidden' if has_memory else ''}; see docs/policies.md"
            )
        action, *next_hidden = outputs
        return action, next_hidden[0] if has_memory else hidden

    dropped = tuple(
        Note(
            "dropped_input",
            f"{path}: has no input {name!r}: exporters drop unused inputs; it is flown without it",
            f"if it should use it, use {name} in forward() and export again",
        )
        for name in INPUTS[:2]
        if name not in names
    )
    notes = (*metadata.notes, *dropped)
    policy = BlockPolicy(path.name, metadata.spec, model, hidden_shape, block, block, notes)
    return verify_rows(policy, str(path))


def inputs_message(where: str, names: tuple[str, ...]) -> str:
    """Return the error message for a program whose inputs have other names."""
    fix = "name forward()'s arguments so, or give input_names to torch.onnx.export"
    if len(names) > len(INPUTS):
        fix = "join several memories, such as the two of an LSTM, to one input and output"
    return (
        f"{where}: inputs are {', '.join(names) or 'none'}; expected {', '.join(INPUTS)} in this "
        f"order (hidden may be left out); {fix}"
    )

"""Checks of the inputs of a foreign policy, for all formats."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from policies.block_policy import BLOCK
from policies.formats.spec_json import KEY, PolicyMetadata
from policies.spec import EXTRAS, Note, PolicyError, PolicySpec

INPUTS = ("state", "image", "hidden")
"""Names of a program's inputs, in order; a policy without memory leaves the last out."""


BLOCK_MOST = 4096
"""Largest batch of a model with a fixed batch."""
HIDDEN_MOST = 2**16
"""Largest recurrent state of one row."""


def check_inputs(
    shapes: dict[str, tuple[Any, ...]], spec: PolicySpec, where: str
) -> tuple[int, tuple[int, ...]]:
    """Return (rows a block, shape of a row's hidden state) from a program's inputs.

    Args:
        shapes: by input name, in order; sizes that are not ints are free.
        spec: the file's spec.
        where: the file, for the message.

    Raises:
        PolicyError: where names, ranks or sizes are not those of an observation.
    """
    if not shapes or not set(shapes) <= set(INPUTS):
        raise PolicyError(inputs_message(where, tuple(shapes)))
    rows = {shape[0] for shape in shapes.values() if shape and isinstance(shape[0], int)}
    block = rows.pop() if rows else BLOCK
    hidden = shapes.get("hidden", (None, 0))[1:]
    if rows or not hidden or not all(isinstance(size, int) for size in hidden):
        raise PolicyError(
            f"{where}: inputs have shapes {shapes}; all need the batch as first axis, and the "
            "other axes of 'hidden' must be fixed"
        )
    if not 1 <= block <= BLOCK_MOST or not 0 <= math.prod(hidden) <= HIDDEN_MOST:
        raise PolicyError(
            f"{where}: inputs have shapes {shapes}; allowed are batches of 1 to {BLOCK_MOST} rows "
            f"and up to {HIDDEN_MOST} numbers in 'hidden'"
        )
    for name, expected in (("state", (spec.state_size,)), ("image", spec.image_shape)):
        if name not in shapes:
            continue
        found = shapes[name][1:]
        free = len(found) == len(expected) and all(
            size == want or not isinstance(size, int)
            for size, want in zip(found, expected, strict=True)
        )
        if not free:
            raise PolicyError(
                f"{where}: input {name!r} has shape {shapes[name]}, expected (batch, "
                f"{', '.join(map(str, expected))}); the camera's size, {', '.join(EXTRAS)} "
                f"and the kind of action stand in {KEY} or in its contract"
            )
    return block, tuple(hidden)


def check_memory(metadata: PolicyMetadata, hidden_shape: tuple[int, ...], where: str) -> None:
    """Refuse a memory of another shape than the contract's.

    Raises:
        PolicyError: naming both.
    """
    shape = metadata.contract.memory if metadata.contract else None
    if shape is not None and tuple(shape) != (hidden_shape if hidden_shape != (0,) else ()):
        raise PolicyError(
            f"{where}: its contract says a memory of shape {list(shape)}, its input 'hidden' has "
            f"{list(hidden_shape)}; export the policy again with its own contract"
        )


def dropped_inputs(names: Iterable[str], where: str) -> tuple[Note, ...]:
    """Return notes on inputs that an exporter has dropped because nothing uses them."""
    missing = [name for name in INPUTS[:2] if name not in names]
    return tuple(
        Note(
            "dropped_input",
            f"{where}: has no input {name!r}: exporters drop unused inputs, and it flies without",
            f"if it should use it, use {name} in forward() and export again",
        )
        for name in missing
    )


def inputs_message(where: str, names: tuple[str, ...]) -> str:
    """Return the error's message for a program whose inputs have other names."""
    return (
        f"{where}: inputs are {', '.join(names) or 'none'}; expected {', '.join(INPUTS)} in this "
        "order (hidden may be left out); name forward()'s arguments so, or give input_names to "
        "torch.onnx.export"
    )

"""Torch exported programs (.pt2) and TorchScript (.pt) as `Policy`, on one CPU thread.

Neither is loaded without trust: `torch.jit.load` runs what a file says by design, and
`torch.export.load` unpickles sample inputs and some weights, resolves operators by dotted paths and
evaluates expressions, all from the file; torch has no safe mode for it.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from policies.block_policy import BlockPolicy, proven
from policies.errors import NoAnswer, PolicyError
from policies.formats.embedded_spec import KEY, extract
from policies.formats.program_inputs import INPUTS, check_inputs, inputs_message
from policies.spec import ACTION_SIZE
from tracks.input.reading import MODEL_BYTES, InputError, check_file


def load_program(path: Path, trust: bool = False) -> BlockPolicy:
    """Return the policy of a torch exported program.

    Raises:
        PolicyError: without trust, or where the file is damaged or its inputs and outputs do not
            fit.
    """
    _check_trusted(path, "a torch exported program", trust)
    _check_file(path)
    extra = {KEY: ""}
    with _refusing(path):
        program = torch.export.load(path, extra_files=extra)
    spec = extract(extra[KEY], str(path))
    inputs = program.graph_signature.user_inputs
    values = {node.name: node.meta.get("val") for node in program.graph.nodes}
    shapes = {str(name): tuple(getattr(values.get(str(name)), "shape", ())) for name in inputs}
    block, hidden_shape = check_inputs(shapes, spec, str(path))
    with _refusing(path):
        module = program.module(check_guards=False)
    model = _as_model(module, path, hidden_shape)
    return proven(BlockPolicy(path.name, spec, model, hidden_shape, block, block), str(path))


def load_script(path: Path, trust: bool = False) -> BlockPolicy:
    """Return the policy of a TorchScript file.

    Raises:
        PolicyError: without trust, or where it is no TorchScript or its inputs and outputs do not
            fit.
    """
    _check_trusted(path, "TorchScript", trust)
    _check_file(path)
    extra = {KEY: ""}
    with _refusing(path):
        module = torch.jit.load(str(path), map_location="cpu", _extra_files=extra).eval()
    spec = extract(extra[KEY], str(path))
    names = tuple(argument.name for argument in module.forward.schema.arguments[1:])
    if names not in (INPUTS, INPUTS[:2]):
        raise PolicyError(inputs_message(str(path), names))
    hidden_shape = (spec.hidden_size,) if names == INPUTS else (0,)
    model = _as_model(module, path, hidden_shape)
    return proven(BlockPolicy(path.name, spec, model, hidden_shape), str(path))


def _check_trusted(path: Path, kind: str, trust: bool) -> None:
    if not trust:
        raise PolicyError(
            f"{path}: {kind} can run any code of its maker's while torch loads it; if you trust "
            "who made the file, pass --trust; a policy to be shared needs none as .onnx "
            "(torch.onnx.export; suite export for one of ours)"
        )


def _check_file(path: Path) -> None:
    try:
        check_file(path, MODEL_BYTES)
    except InputError as error:
        raise PolicyError(str(error)) from None


def _as_model(module: Callable[..., Any], path: Path, hidden_shape: tuple[int, ...]) -> Any:
    memory = hidden_shape != (0,)

    def model(
        state: np.ndarray, image: np.ndarray, hidden: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        arrays = (state, image, hidden) if memory else (state, image)
        inputs = [torch.from_numpy(np.ascontiguousarray(x)) for x in arrays]
        with _one_thread(), torch.inference_mode():
            try:
                found = module(*inputs)
            except Exception as error:  # whatever the file's own code and torch raise
                line = (str(error).strip() or type(error).__name__).splitlines()[-1][:200]
                raise NoAnswer(f"{path}: fails while it runs ({line}); export it again") from error
        outputs = list(found) if isinstance(found, (tuple, list)) else [found]
        if len(outputs) != 1 + memory or not all(isinstance(x, torch.Tensor) for x in outputs):
            raise PolicyError(
                f"{path}: gives {len(outputs)} outputs, expected the tensors action (batch, "
                f"{ACTION_SIZE}){' and hidden' if memory else ''}; see docs/policies.md"
            )
        action, *after = (x.numpy() for x in outputs)
        return action, after[0] if memory else hidden

    return model


@contextlib.contextmanager
def _one_thread() -> Iterator[None]:
    """Sums are split by threads, so a fixed number of them keeps a policy's answers the same."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextlib.contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Turn whatever torch raises on a file it cannot read into one error for people."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except Exception as error:
        line = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise PolicyError(
            f"{path}: torch {torch.__version__} cannot load it ({line}); export it again with "
            "this version of torch"
        ) from error

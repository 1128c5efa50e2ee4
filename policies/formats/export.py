"""Export the suite's policies as torch program (.pt2), ONNX or C, and any torch module as ONNX."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from policies import contract, shipped
from policies.formats.c.arrays import DTYPES
from policies.formats.policy_file import PolicyCheckpoint, load_policy_checkpoint
from policies.formats.program_inputs import INPUTS
from policies.formats.spec_json import labels
from policies.spec import PolicyError, PolicySpec
from tracks.common.files import replacing_file, write_files
from tracks.common.names import unknown_name
from tracks.input.ranges import check_type

if TYPE_CHECKING:
    import torch

    from policies.formats.c.forward import Observed


def export_policy(
    name_or_folder: str | Path,
    out: Path,
    formats: Iterable[str] = ("torch", "onnx"),
    dtype: str = "float32",
    observed: Observed | None = None,
) -> list[Path]:
    """Export one of the suite's policies; `load_policy` reads all formats (.pt2 and C with trust).

    The files are NAME.pt2 and NAME.onnx; for C policy.h, policy.c and a program that tests them.
    Weights in C are "float32" or "int8", whose scales of activations follow from `observed` in
    flights.

    Returns:
        The files' paths.

    Raises:
        PolicyError: where the checkpoint cannot be used, or int8 has no observations.
        ValueError: for an unknown format or type, or a type that the format does not support.
        OSError: where a file cannot be written; none is written then.
    """
    formats = list(formats)
    check_formats(formats, dtype)
    name, checkpoint = exported_checkpoint(name_or_folder)
    texts = labels(checkpoint.spec, name, checkpoint.seed)
    files: dict[str, bytes] = {}
    for format_name in formats:
        if format_name == "c":
            from policies.formats.c.project import c_project

            project = c_project(checkpoint, name, dtype, observed).files
            files |= {file: text.encode() for file, text in project.items()}
        else:
            _, write = _WRITERS[format_name]
            files[file_names(name, format_name)[0]] = write(checkpoint, texts)
    return write_files(out, files)


def export_module(
    module: torch.nn.Module,
    path: str | Path,
    trained_under: PolicySpec | contract.Contract,
    memory: tuple[int, ...] | None = None,
) -> Path:
    """Export a torch module as ONNX with its contract, and load the file once as the judge does.

    The module is exported in evaluation mode, with a free batch size, by torch's TorchScript
    exporter, which needs no further package. The judge (the part of the suite that flies and scores
    policies) refuses files that it cannot run, so the file is loaded once as a test before it
    replaces one at `path`.

    Args:
        module: the module. Its `forward` takes (state, image) or (state, image, hidden), float32
            with the batch first, and returns the action, or (action, hidden).
        path: path of the new file, ending in .onnx.
        trained_under: contract of the environment (`env.unwrapped.contract`), or its spec.
        memory: shape of one row's hidden state; None for a module without memory.

    Returns:
        `path`.

    Raises:
        ValueError: for an argument of another type.
        PolicyError: for a path with another ending, and where torch cannot export the module, the
            judge refuses the file, or no action is finite.
    """
    if Path(path).suffix != ".onnx":
        raise PolicyError(f"{path}: the name of a module's file must end in .onnx")
    import numpy as np
    import onnx
    import torch

    from policies.block_policy import random_block
    from policies.formats.onnx_file import load_onnx
    from policies.formats.onnx_graph import OPSET

    check_type("module", module, (torch.nn.Module,), "a torch.nn.Module")
    kinds = (PolicySpec, contract.Contract)
    check_type("trained_under", trained_under, kinds, "env.unwrapped.contract or a PolicySpec")
    check_type("memory", memory, (tuple, list, type(None)), "a shape such as (64,), or None")
    spec = trained_under
    if not isinstance(spec, PolicySpec):
        spec = contract.spec_of(spec, str(path))
    policy_contract = contract.contract_of(spec, memory or ())
    sizes = [(spec.state_size,), spec.image_shape, *([memory] if memory else [])]
    names = INPUTS[: len(sizes)]
    example = tuple(torch.zeros(2, *size) for size in sizes)
    outputs = ["action", "hidden_next"][: 1 + bool(memory)]
    buffer: Any = io.BytesIO()  # torch accepts it, but its annotation omits it
    modes = {part: part.training for part in module.modules()}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the deprecation of this exporter
            torch.onnx.export(
                module.eval(), example, buffer, input_names=list(names), output_names=outputs,
                dynamic_axes={name: {0: "batch"} for name in (*names, *outputs)},
                opset_version=OPSET, dynamo=False,
            )  # fmt: skip
    except Exception as error:
        text = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise PolicyError(
            f"{path}: torch cannot export the module ({text}); its forward must take "
            f"{', '.join(names)} and return {' and '.join(outputs)}"
        ) from error
    finally:
        # Not by module.train(), since parts may be frozen in evaluation mode during a training.
        for part, mode in modes.items():
            part.training = mode
    proto = onnx.load_model_from_string(buffer.getvalue())
    onnx.helper.set_model_props(proto, {contract.KEY: policy_contract.text})
    with replacing_file(path) as temporary:
        temporary.write_bytes(proto.SerializeToString())
        try:
            loaded = load_onnx(temporary)
        except PolicyError as error:
            raise PolicyError(str(error).replace(str(temporary), str(path))) from None
        action, _ = loaded.model(*random_block(loaded, np.random.default_rng(0)))
        if not np.isfinite(action).all(axis=1).any():
            raise PolicyError(
                f"{path}: the module's actions are NaN or infinite; check its weights and its "
                "normalisation"
            )
    return Path(path)


def file_names(name: str, format: str) -> tuple[str, ...]:
    """Return the names of the policy's files in one of `FORMATS`, the main file first."""
    from policies.formats.c.project import FILES

    return FILES if format == "c" else (f"{name}{_WRITERS[format][0]}",)


def check_formats(formats: Sequence[str], dtype: str = "float32") -> None:
    """Refuse formats and types that cannot be written.

    Raises:
        ValueError: for no format, an unknown format or type, or a type that the format does not
            support.
    """
    if not formats:
        raise ValueError(f"no format is given; allowed are one or more of {', '.join(FORMATS)}")
    if dtype not in DTYPES:
        raise unknown_name("type", dtype, DTYPES)
    for format in formats:
        if format not in FORMATS:
            raise unknown_name("format", format, FORMATS)
        if dtype != "float32" and format != "c":
            raise ValueError(f"format {format} supports float32 only; {dtype} needs --format c")


def exported_checkpoint(name_or_folder: str | Path) -> tuple[str, PolicyCheckpoint]:
    """Return the name and the checkpoint of one of the suite's policies.

    Raises:
        PolicyError: where the name or folder is no policy of the suite, or cannot be used.
    """
    folder = shipped.locate(name_or_folder)
    if not folder.is_dir():
        raise PolicyError(
            f"{name_or_folder}: not a shipped policy ({', '.join(shipped.names()) or 'none'}) and "
            "not a checkpoint's folder; only policies of the suite can be exported"
        )
    return folder.resolve().name, load_policy_checkpoint(folder)


def torch_program(checkpoint: PolicyCheckpoint, texts: dict[str, str]) -> bytes:
    """Return a policy as the bytes of a .pt2 file, with `texts` as extra files by name."""
    import torch

    from policies.formats.torch_twin import torch_twin

    spec = checkpoint.spec
    twin = torch_twin(checkpoint.params, spec)
    # Two rows, because torch treats sizes 0 and 1 in an example as fixed.
    example = (
        torch.zeros(2, spec.state_size),
        torch.zeros(2, spec.camera.height, spec.camera.width),
        torch.zeros(2, spec.hidden_size),
    )
    batch = {0: torch.export.Dim("batch")}
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        program = torch.export.export(twin, example, dynamic_shapes=(batch, batch, batch))
        torch.export.save(program, buffer, extra_files=texts)
    return buffer.getvalue()


def onnx_file(checkpoint: PolicyCheckpoint, texts: dict[str, str]) -> bytes:
    """Return a policy as the bytes of an .onnx file, with `texts` as metadata by key."""
    from policies.formats.onnx_graph import onnx_model

    return onnx_model(checkpoint.params, checkpoint.spec, texts).SerializeToString()


_WRITERS: dict[str, tuple[str, Callable[[PolicyCheckpoint, dict[str, str]], bytes]]] = {
    "torch": (".pt2", torch_program),
    "onnx": (".onnx", onnx_file),
}
"""Format -> ending of the file, and function that returns the file's bytes."""
FORMATS = (*_WRITERS, "c")
"""Names of the formats."""

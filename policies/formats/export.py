"""Our policy written for other programs: torch exported program (.pt2) and ONNX."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable, Iterable
from pathlib import Path

from policies import shipped
from policies.errors import PolicyError
from policies.formats.embedded_spec import KEY, embed
from policies.formats.policy_file import PolicyCheckpoint, load_policy_checkpoint
from tracks.common.files import replacing_file
from tracks.common.names import unknown_name


def export_policy(
    name_or_folder: str | Path, out: Path, formats: Iterable[str] = ("torch", "onnx")
) -> list[Path]:
    """Write a policy of ours as torch program and ONNX; `load_policy` reads both (.pt2 with trust).

    Args:
        name_or_folder: a shipped policy's name or a checkpoint's folder.
        out: the folder that the files go to, as NAME.pt2 and NAME.onnx.
        formats: which of "torch" and "onnx".

    Returns:
        The files' paths.

    Raises:
        PolicyError: where the checkpoint cannot be used.
        ValueError: for an unknown format.
        OSError: where the disk refuses; no half file is left.
    """
    folder = shipped.locate(name_or_folder)
    if not folder.is_dir():
        raise PolicyError(
            f"{name_or_folder}: not a shipped policy ({', '.join(shipped.names()) or 'none'}) and "
            "not a checkpoint's folder; only policies of ours can be exported"
        )
    chosen = list(formats)
    for wanted in chosen:
        if wanted not in _WRITERS:
            raise unknown_name("format", wanted, _WRITERS)
    checkpoint = load_policy_checkpoint(folder)
    name = folder.resolve().name
    label = embed(checkpoint.spec, name, checkpoint.config["seed"])
    written = []
    for wanted in chosen:
        suffix, write = _WRITERS[wanted]
        path = out / f"{name}{suffix}"
        data = write(checkpoint, label)
        with replacing_file(path) as beside:
            beside.write_bytes(data)
        written.append(path)
    return written


def torch_program(checkpoint: PolicyCheckpoint, label: str) -> bytes:
    """Return a policy as the bytes of a .pt2 file, `label` under `embedded_spec.KEY`."""
    import torch

    from policies.formats.torch_twin import torch_twin

    spec = checkpoint.spec
    twin = torch_twin(checkpoint.params, spec)
    # Two rows, since torch takes sizes 0 and 1 in an example for fixed.
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
        torch.export.save(program, buffer, extra_files={KEY: label})
    return buffer.getvalue()


def onnx_file(checkpoint: PolicyCheckpoint, label: str) -> bytes:
    """Return a policy as the bytes of an .onnx file, `label` under `embedded_spec.KEY`."""
    from policies.formats.onnx_graph import onnx_model

    return onnx_model(checkpoint.params, checkpoint.spec, {KEY: label}).SerializeToString()


_WRITERS: dict[str, tuple[str, Callable[[PolicyCheckpoint, str], bytes]]] = {
    "torch": (".pt2", torch_program),
    "onnx": (".onnx", onnx_file),
}

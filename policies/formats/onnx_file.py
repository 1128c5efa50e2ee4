"""Load an ONNX file as a `Policy`: it is checked, and run by onnxruntime in a separate process.

Files with operators outside the ONNX standard, or with data outside their folder, are refused.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import onnx
import onnx.inliner

from policies.block_policy import BlockPolicy
from policies.formats.model_process import ModelProcess
from policies.formats.program_inputs import described_policy, read_model
from policies.formats.spec_json import extract
from policies.spec import PolicyError
from tracks.input.reading import MODEL_BYTES

_STANDARD = ("", "ai.onnx")
"""Names of the domain of standard operators."""
NODES_MOST = 100_000
"""Largest number of operators of a graph after its functions are inlined."""


def load_onnx(path: Path) -> BlockPolicy:
    """Return the policy of an ONNX file.

    Raises:
        PolicyError: where the file is damaged, uses operators outside the standard or data
            outside its folder, or its inputs and outputs do not fit.
    """
    proto = read_checked(path)
    metadata = extract({entry.key: entry.value for entry in proto.metadata_props}, str(path))
    loaded = ModelProcess(proto.SerializeToString(), str(path), "onnx")
    for value in (*loaded.inputs, *loaded.outputs):
        if value.kind != "tensor(float)":
            raise PolicyError(
                f"{path}: {value.name!r} is {value.kind}, expected tensor(float); export it as "
                "float32, such as by model.float() in PyTorch"
            )
    outputs = [value.name for value in loaded.outputs]
    if "action" in outputs[1:]:
        raise PolicyError(
            f"{path}: outputs are {', '.join(outputs)}; the action must be the first, then the new "
            "hidden; export it with the outputs in this order"
        )
    return described_policy(loaded, path, metadata)


def read_checked(path: Path) -> onnx.ModelProto:
    """Read an ONNX file with its external data, and check that it is harmless.

    Raises:
        PolicyError: where it is damaged, too large, not standard, or points outside its folder.
    """
    proto = _inlined(path, _graph_of(path))
    if proto.training_info:
        raise PolicyError(f"{path}: has training graphs; export it for inference only")
    for graph in _graphs(proto.graph):
        for node in graph.node:
            _check_text(path, node.op_type, node.domain)
            if node.domain not in _STANDARD:
                raise PolicyError(
                    f"{path}: operator {node.op_type!r} is of domain {node.domain!r}; only "
                    "standard operators are loaded: export without custom operators or "
                    "runtime-specific optimisation"
                )
            if not onnx.defs.has(node.op_type):
                raise PolicyError(f"{path}: operator {node.op_type!r} is not in the ONNX standard")
    external = [tensor for tensor in _tensors(proto) if tensor.external_data]
    size = path.stat().st_size + _external_bytes(path, external)
    if size > MODEL_BYTES:
        raise PolicyError(f"{path}: {size} bytes with its data, allowed are up to {MODEL_BYTES}")
    try:
        if external:
            onnx.load_external_data_for_model(proto, str(path.resolve().parent))
        onnx.checker.check_model(proto)
    except Exception as error:
        raise PolicyError(f"{path}: breaks the ONNX standard ({_first_line(error)})") from error
    return proto


def _inlined(path: Path, proto: onnx.ModelProto) -> onnx.ModelProto:
    """Return the model with its local functions (as torch's exporter writes them) inlined.

    Raises:
        PolicyError: where functions are recursive, or expand to more than `NODES_MOST` operators.
    """
    if not proto.functions:
        return proto
    functions = {(f.domain, f.name): f for f in proto.functions}
    sizes: dict[tuple[str, str], int] = {}

    def size(nodes: Any, callers: tuple[tuple[str, str], ...] = ()) -> int:
        """Return the number of operators after inlining; `callers` are the enclosing functions."""
        total = 0
        for node in nodes:
            key = (node.domain, node.op_type)
            if key in callers or len(callers) > len(functions):
                raise PolicyError(f"{path}: function {key[1]!r} calls itself; export it again")
            if key in functions and key not in sizes:
                sizes[key] = size(functions[key].node, (*callers, key))
            total += sizes.get(key, 1)
            for attribute in node.attribute:
                for graph in (attribute.g, *attribute.graphs):
                    total += size(graph.node, callers)
        return total

    if size(proto.graph.node) > NODES_MOST:
        raise PolicyError(f"{path}: its functions expand to more than {NODES_MOST} operators")
    try:
        return onnx.inliner.inline_local_functions(proto)
    except Exception as error:
        text = f"{path}: its local functions cannot be inlined ({_first_line(error)})"
        raise PolicyError(f"{text}; export with torch.onnx.export(..., dynamo=False)") from None


def files_of(path: Path) -> list[Path]:
    """Return an ONNX file and the files with its external data, sorted by name.

    Raises:
        PolicyError: where it is damaged or points outside its folder.
    """
    external = {_data_file(path, t) for t in _tensors(_graph_of(path)) if t.external_data}
    return [path, *sorted(external)]


def _graph_of(path: Path) -> onnx.ModelProto:
    """Return the model of a file, without its external data and unchecked."""
    data = read_model(path)
    try:
        return onnx.load_model_from_string(data)
    except Exception as error:  # protobuf's DecodeError; the suite does not depend on protobuf
        raise PolicyError(
            f"{path}: not a complete ONNX file ({_first_line(error)}); export it again"
        ) from None


def _external_bytes(path: Path, tensors: list[Any]) -> int:
    """Return the size of external data: of its files, or of all its tensors if that is larger."""
    sizes, in_memory = {}, 0
    for tensor in tensors:
        file = _data_file(path, tensor)
        sizes[file] = file.stat().st_size
        # Tensors may share a file's bytes, but each is read into memory separately.
        in_memory += _tensor_bytes(_external(tensor), sizes[file])
    return max(sum(sizes.values()), in_memory)


def _tensor_bytes(entries: dict[str, Any], size: int) -> int:
    """Return the size of a tensor in a file of `size` bytes; `size` if the entries are unusable."""
    try:
        bytes_from_offset = size - int(entries.get("offset", 0))
        return max(0, min(int(entries.get("length", bytes_from_offset)), bytes_from_offset))
    except ValueError:
        return size


def _external(tensor: onnx.TensorProto) -> dict[str, Any]:
    """Return the entries that locate a tensor's data; the last one of a key counts, as in onnx."""
    return {entry.key: entry.value for entry in tensor.external_data}


def _data_file(path: Path, tensor: onnx.TensorProto) -> Path:
    """Return the file with a tensor's data, which must be in the same folder."""
    location = _external(tensor).get("location", "")
    _check_text(path, location)
    folder = path.resolve().parent
    file = (folder / location).resolve()
    if not location or Path(location).is_absolute() or not file.is_relative_to(folder):
        raise PolicyError(
            f"{path}: tensor {tensor.name!r} is in {location!r}, outside the file's folder; export "
            "with the data inside"
        )
    if not file.is_file():
        raise PolicyError(f"{path}: tensor {tensor.name!r} is in {file}, which is missing")
    return file


def _check_text(path: Path, *texts: object) -> None:
    """Refuse fields that are not text, which protobuf returns as bytes."""
    if not all(isinstance(text, str) and "\0" not in text for text in texts):
        raise PolicyError(f"{path}: names in it are not UTF-8 ({texts}); export it again")


def _graphs(graph: onnx.GraphProto) -> Iterator[onnx.GraphProto]:
    """Yield a graph and all graphs inside its nodes."""
    yield graph
    for node in graph.node:
        for attribute in node.attribute:
            if attribute.HasField("g"):
                yield from _graphs(attribute.g)
            for inner in attribute.graphs:
                yield from _graphs(inner)


def _tensors(proto: onnx.ModelProto) -> Iterator[Any]:
    """Yield every tensor that is stored anywhere in the file."""
    for graph in _graphs(proto.graph):
        yield from graph.initializer
        for sparse in graph.sparse_initializer:
            yield from (sparse.values, sparse.indices)
        for node in graph.node:
            for attribute in node.attribute:
                yield from (attribute.t, *attribute.tensors)
                for sparse in (attribute.sparse_tensor, *attribute.sparse_tensors):
                    yield from (sparse.values, sparse.indices)


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]

"""The program that runs one foreign model: ONNX, TorchScript, a torch program or a C library.

`model_process.py` starts it by its path, so it imports nothing of the suite. It reads frames from
standard input and writes an answer to each to standard output. A frame has three parts: the length
of the header (four bytes), the header (JSON), and data. The header gives the size of the data,
either as "bytes" or as the names and shapes of float32 arrays under "arrays". The first frame has
the model, its kind and the limits; each further frame has the inputs of one call, in the model's
order. If the model cannot be loaded or fails, the answer has "error" instead of arrays.

If a call exceeds its time limit, an alarm signal ends the process, even after its parent has ended.
"""

from __future__ import annotations

import importlib
import io
import json
import math
import os
import resource
import signal
import struct
import sys
from collections.abc import Callable
from typing import IO, Any

Run = Callable[[dict[str, Any]], list[Any]]
"""A function from inputs by name to outputs, all float32 arrays."""
Loaded = tuple[dict[str, Any], Run]
"""Description of a model (its inputs, outputs and texts), and its function."""


def write_frame(file: IO[bytes], header: dict[str, Any], *data: Any) -> None:
    """Write one frame: its header, then the buffers of its data."""
    text = json.dumps(header).encode()
    file.write(struct.pack("<I", len(text)) + text)
    for part in data:
        file.write(part)
    file.flush()


def read_frame(file: IO[bytes]) -> tuple[dict[str, Any], bytearray]:
    """Return the header and the data of one frame.

    Raises:
        EOFError: where the other side has closed the pipe.
    """
    (length,) = struct.unpack("<I", _read(file, 4))
    header = json.loads(_read(file, length))
    return header, _read(file, data_bytes(header))


def data_bytes(header: dict[str, Any]) -> int:
    """Return the number of bytes of data that follow a header."""
    arrays = header.get("arrays", ())
    return header.get("bytes", 0) + sum(4 * math.prod(shape) for _, shape in arrays)


def _read(file: IO[bytes], count: int) -> bytearray:
    """Return exactly `count` bytes."""
    data = bytearray(count)
    view, done = memoryview(data), 0
    while done < count:
        read = file.readinto(view[done:])  # type: ignore[attr-defined]
        if not read:
            raise EOFError
        done += read
    return data


def load_onnx(onnxruntime: Any, model: bytes, labels: list[str]) -> Loaded:
    """Load an ONNX model; `labels` is unused, because the parent process reads the texts."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    description = {
        side: [[value.name, value.type, [_size(n) for n in value.shape or ()]] for value in values]
        for side, values in (("inputs", session.get_inputs()), ("outputs", session.get_outputs()))
    }
    output_names = [name for name, _, _ in description["outputs"]]
    return description, lambda feed: session.run(output_names, feed)


def load_program(torch: Any, model: bytes, labels: list[str]) -> Loaded:
    """Load a torch exported program and its texts under `labels`."""
    extra = dict.fromkeys(labels, "")
    program = torch.export.load(io.BytesIO(model), extra_files=extra)
    values = {node.name: node.meta.get("val") for node in program.graph.nodes}
    inputs = []
    for name in map(str, program.graph_signature.user_inputs):
        shape = getattr(values.get(name), "shape", ())
        inputs.append([name, "", [_size(n) for n in shape]])
    description = {"inputs": inputs, "outputs": [], "labels": extra}
    return description, _torch_run(torch, program.module(check_guards=False))


def load_script(torch: Any, model: bytes, labels: list[str]) -> Loaded:
    """Load TorchScript and its texts under `labels`; shapes are unknown."""
    extra = dict.fromkeys(labels, "")
    module = torch.jit.load(io.BytesIO(model), map_location="cpu", _extra_files=extra).eval()
    inputs = [[argument.name, "", []] for argument in module.forward.schema.arguments[1:]]
    texts = {
        key: text.decode(errors="replace") if isinstance(text, bytes) else text
        for key, text in extra.items()
    }
    return {"inputs": inputs, "outputs": [], "labels": texts}, _torch_run(torch, module)


def _torch_run(torch: Any, module: Callable[..., Any]) -> Run:
    """Return the function that runs a torch module on numpy arrays."""
    # Threads split sums, so a fixed number of them makes outputs reproducible.
    torch.set_num_threads(1)

    def run(feed: dict[str, Any]) -> list[Any]:
        # A clone has torch's memory alignment, which does not depend on the place in the frame.
        inputs = [torch.from_numpy(value).clone() for value in feed.values()]
        with torch.inference_mode():
            try:
                result = module(*inputs)
            except Exception as error:  # the code of the file may raise anything
                raise RuntimeError(_lines(error)[-1]) from error
        outputs = list(result) if isinstance(result, (tuple, list)) else [result]
        for number, value in enumerate(outputs):
            if getattr(value, "dtype", None) is not torch.float32:
                kind = getattr(value, "dtype", type(value).__name__)
                raise TypeError(f"output {number} is {kind}, expected a tensor of float32")
        return [value.numpy() for value in outputs]

    return run


def load_library(ctypes: Any, path: bytes, labels: list[str]) -> Loaded:
    """Load a C policy's shared library from its path.

    A frame has float32 arrays only. So a policy's memory, of any type, is sent as its bytes in
    float32 words, and the flag that a row begins a new flight as a float32.
    """
    import numpy as np

    library = ctypes.CDLL(path.decode())
    library.suite_json.restype = ctypes.c_char_p
    state_bytes, *sizes = (library.suite_size(number) for number in range(5))
    text = library.suite_json().decode(errors="replace")
    description = {
        "inputs": [],
        "outputs": [],
        "labels": {labels[0]: text},
        "sizes": [state_bytes, *sizes],
    }

    def run(feed: dict[str, Any]) -> list[Any]:
        words = feed["memory"]
        memory = np.ascontiguousarray(words.view(np.uint8)[:, :state_bytes])
        fresh = feed["fresh"].astype(np.uint8)
        action = np.empty(feed["action"].shape, np.float32)
        arrays = (memory, fresh, feed["state"], feed["image"], action)
        library.suite_rows(*action.shape, *(ctypes.c_void_p(array.ctypes.data) for array in arrays))
        next_words = np.zeros(words.shape, np.float32)
        next_words.view(np.uint8)[:, :state_bytes] = memory
        return [action, next_words]

    return description, run


KINDS: dict[str, tuple[str, Callable[[Any, bytes, list[str]], Loaded]]] = {
    "onnx": ("onnxruntime", load_onnx),
    "program": ("torch", load_program),
    "script": ("torch", load_script),
    "library": ("ctypes", load_library),
}
"""Kind of model -> the Python module that runs it, and the function that loads it."""


def serve(source: IO[bytes], answers: IO[bytes]) -> None:
    """Load the model of the first frame and answer until the parent closes the input."""
    header, model = read_frame(source)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, header["load_s"])
    name, load = KINDS[header["kind"]]
    engine = importlib.import_module(name)
    # The limit excludes the engine's libraries: those of torch may take gigabytes of addresses.
    address_limit = _address_space() + header["memory_bytes"]
    _, system_limit = resource.getrlimit(resource.RLIMIT_AS)
    if system_limit != resource.RLIM_INFINITY:
        address_limit = min(address_limit, system_limit)
    resource.setrlimit(resource.RLIMIT_AS, (address_limit, address_limit))
    try:
        description, run = load(engine, bytes(model), header["labels"])
    except Exception as error:  # onnxruntime's exceptions have no common public base class
        write_frame(answers, {"error": _lines(error)[0], "version": engine.__version__})
        return
    del model
    signal.setitimer(signal.ITIMER_REAL, 0)
    write_frame(answers, description)
    _answer(source, answers, run, header["answer_s"])


def _answer(source: IO[bytes], answers: IO[bytes], run: Run, answer_s: float) -> None:
    """Answer frames with inputs until the parent closes the input."""
    import numpy as np

    while True:
        try:
            request, data = read_frame(source)
        except EOFError:
            return
        signal.setitimer(signal.ITIMER_REAL, answer_s)
        feed, offset = {}, 0
        for name, shape in request["arrays"]:
            count = math.prod(shape)
            feed[name] = np.frombuffer(data, np.float32, count, offset).reshape(shape)
            offset += 4 * count
        try:
            outputs = [np.ascontiguousarray(value) for value in run(feed)]
        except Exception as error:
            write_frame(answers, {"error": _lines(error)[0]})
            continue
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        shapes = [[str(number), list(value.shape)] for number, value in enumerate(outputs)]
        write_frame(answers, {"arrays": shapes}, *outputs)


def _address_space() -> int:
    """Return the size of this process's address space [bytes], 0 where the system has no /proc."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[0]) * resource.getpagesize()
    except OSError:
        return 0


def _size(size: Any) -> int | None:
    """Return the size of an axis; None for an axis of any size."""
    return size if isinstance(size, int) else None


def _lines(error: Exception) -> list[str]:
    """Return the lines of an error's message, each cut to 200 characters."""
    text = str(error).strip() or type(error).__name__
    return [line[:200] for line in text.splitlines()]


if __name__ == "__main__":
    # Native libraries may print; their output goes to standard error, apart from the answers.
    to_parent = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        serve(os.fdopen(0, "rb", buffering=0), to_parent)
    except BrokenPipeError:
        sys.exit(1)

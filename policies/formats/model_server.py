"""The program that runs one foreign model: ONNX, TorchScript, a torch program or a C library.

It imports nothing of the suite and is run by its path. Frames come on standard input, answers go to
output. A frame is four bytes of length, a JSON object of that length, and the bytes of the float32
arrays whose names and shapes it lists under "arrays" (bytes as they are under "bytes"). The first
frame holds the model, its kind and the limits; each other one, the inputs of one call, in the
model's order. An answer has "error" instead of arrays where the model cannot be loaded or fails.

An alarm signal ends the process where a call exceeds its limit, even without a parent.
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
"""Inputs by name to the outputs, float32 arrays all."""
Loaded = tuple[dict[str, Any], Run]
"""Description of a model, and its function."""


def write_frame(file: IO[bytes], head: dict[str, Any], *data: Any) -> None:
    """Write one frame: its head, then the buffers of its data."""
    text = json.dumps(head).encode()
    file.write(struct.pack("<I", len(text)) + text)
    for part in data:
        file.write(part)
    file.flush()


def read_frame(file: IO[bytes]) -> tuple[dict[str, Any], bytearray]:
    """Return one frame's head and its data.

    Raises:
        EOFError: where the other side has closed the pipe.
    """
    (length,) = struct.unpack("<I", _exactly(file, 4))
    head = json.loads(_exactly(file, length))
    return head, _exactly(file, data_bytes(head))


def data_bytes(head: dict[str, Any]) -> int:
    """Return how many bytes of data follow a head."""
    return head.get("bytes", 0) + sum(4 * math.prod(shape) for _, shape in head.get("arrays", ()))


def _exactly(file: IO[bytes], count: int) -> bytearray:
    data = bytearray(count)
    view, done = memoryview(data), 0
    while done < count:
        got = file.readinto(view[done:])  # type: ignore[attr-defined]
        if not got:
            raise EOFError
        done += got
    return data


def load_onnx(onnxruntime: Any, model: bytes, labels: list[str]) -> Loaded:
    """Load an ONNX model; the parent process reads its labels."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    about = {
        side: [[value.name, value.type, [_size(n) for n in value.shape or ()]] for value in values]
        for side, values in (("inputs", session.get_inputs()), ("outputs", session.get_outputs()))
    }
    wanted = [name for name, _, _ in about["outputs"]]
    return about, lambda feed: session.run(wanted, feed)


def load_program(torch: Any, model: bytes, labels: list[str]) -> Loaded:
    """Load a torch exported program and its texts under `labels`."""
    extra = dict.fromkeys(labels, "")
    program = torch.export.load(io.BytesIO(model), extra_files=extra)
    values = {node.name: node.meta.get("val") for node in program.graph.nodes}
    inputs = []
    for name in map(str, program.graph_signature.user_inputs):
        shape = getattr(values.get(name), "shape", ())
        inputs.append([name, "", [_size(n) for n in shape]])
    about = {"inputs": inputs, "outputs": [], "labels": extra}
    return about, _torch_run(torch, program.module(check_guards=False))


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
    # Threads split sums, so a fixed number of them makes outputs reproducible.
    torch.set_num_threads(1)

    def run(feed: dict[str, Any]) -> list[Any]:
        # A clone has torch's own memory alignment, independent of its place in the frame.
        inputs = [torch.from_numpy(value).clone() for value in feed.values()]
        with torch.inference_mode():
            try:
                found = module(*inputs)
            except Exception as error:  # whatever the file's own code and torch raise
                raise RuntimeError(_lines(error)[-1]) from error
        outputs = list(found) if isinstance(found, (tuple, list)) else [found]
        for number, value in enumerate(outputs):
            if getattr(value, "dtype", None) is not torch.float32:
                kind = getattr(value, "dtype", type(value).__name__)
                raise TypeError(f"output {number} is {kind}, expected a tensor of float32")
        return [value.numpy() for value in outputs]

    return run


def load_library(ctypes: Any, path: bytes, labels: list[str]) -> Loaded:
    """Load a C policy's shared library, whose path is all that was sent.

    Memories travel as float32 words, whatever they hold; so does the byte that says a row is fresh.
    """
    import numpy as np

    library = ctypes.CDLL(path.decode())
    library.suite_json.restype = ctypes.c_char_p
    state_bytes, *sizes = (library.suite_size(number) for number in range(4))
    text = library.suite_json().decode(errors="replace")
    about = {
        "inputs": [],
        "outputs": [],
        "labels": {labels[0]: text},
        "sizes": [state_bytes, *sizes],
    }

    def run(feed: dict[str, Any]) -> list[Any]:
        words = feed["memory"]
        rows = len(words)
        memory = np.ascontiguousarray(words.view(np.uint8)[:, :state_bytes])
        fresh = feed["fresh"].astype(np.uint8)
        action = np.empty(feed["action"].shape, np.float32)
        arrays = (memory, fresh, feed["state"], feed["image"], action)
        library.suite_rows(rows, *(ctypes.c_void_p(array.ctypes.data) for array in arrays))
        after = np.zeros(words.shape, np.float32)
        after.view(np.uint8)[:, :state_bytes] = memory
        return [action, after]

    return about, run


KINDS: dict[str, tuple[str, Callable[[Any, bytes, list[str]], Loaded]]] = {
    "onnx": ("onnxruntime", load_onnx),
    "program": ("torch", load_program),
    "script": ("torch", load_script),
    "library": ("ctypes", load_library),
}
"""The module that runs a kind of model, and how it is loaded."""


def serve(source: IO[bytes], answers: IO[bytes]) -> None:
    """Load the model of the first frame and answer until the parent closes the input."""
    head, model = read_frame(source)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, head["load_s"])
    name, load = KINDS[head["kind"]]
    engine = importlib.import_module(name)
    # The engine's own libraries are not the model's: torch's alone may be gigabytes of addresses.
    most, (_, allowed) = _addresses() + head["memory_bytes"], resource.getrlimit(resource.RLIMIT_AS)
    if allowed != resource.RLIM_INFINITY:
        most = min(most, allowed)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    try:
        about, run = load(engine, bytes(model), head["labels"])
    except Exception as error:  # onnxruntime's own exceptions share no public base
        write_frame(answers, {"error": _lines(error)[0], "version": engine.__version__})
        return
    del model
    signal.setitimer(signal.ITIMER_REAL, 0)
    write_frame(answers, about)
    _answer(source, answers, run, head["answer_s"])


def _answer(source: IO[bytes], answers: IO[bytes], run: Run, answer_s: float) -> None:
    import numpy as np

    while True:
        try:
            request, data = read_frame(source)
        except EOFError:
            return
        signal.setitimer(signal.ITIMER_REAL, answer_s)
        feed, at = {}, 0
        for name, shape in request["arrays"]:
            count = math.prod(shape)
            feed[name] = np.frombuffer(data, np.float32, count, at).reshape(shape)
            at += 4 * count
        try:
            found = [np.ascontiguousarray(value) for value in run(feed)]
        except Exception as error:
            write_frame(answers, {"error": _lines(error)[0]})
            continue
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        shapes = [[str(number), list(value.shape)] for number, value in enumerate(found)]
        write_frame(answers, {"arrays": shapes}, *found)


def _addresses() -> int:
    """Return the bytes of addresses that this process uses, 0 where the system does not say."""
    try:
        with open("/proc/self/statm", encoding="ascii") as file:
            return int(file.read().split()[0]) * resource.getpagesize()
    except OSError:
        return 0


def _size(size: Any) -> int | None:
    return size if isinstance(size, int) else None


def _lines(error: Exception) -> list[str]:
    text = str(error).strip() or type(error).__name__
    return [line[:200] for line in text.splitlines()]


if __name__ == "__main__":
    # What native libraries print must not come between the answers.
    to_parent = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        serve(os.fdopen(0, "rb", buffering=0), to_parent)
    except BrokenPipeError:
        sys.exit(1)

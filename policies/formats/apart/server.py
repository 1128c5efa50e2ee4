"""The program that runs one ONNX model: frames come on standard input, answers go to the output.

It imports nothing of ours and is run by its path. A frame is four bytes of length, a JSON object of
that length, and the bytes of the float32 arrays whose names and shapes it lists under "arrays"
(bytes as they are under "bytes"). The first frame holds the model and the limits; each other one,
the inputs of one call. An answer has "error" instead of arrays where onnxruntime refuses.

The alarm clock ends it where a call lasts too long, whether or not its parent still lives.
"""

from __future__ import annotations

import json
import math
import os
import resource
import signal
import struct
import sys
from typing import IO, Any


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
        EOFError: where the other side has gone.
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


def serve(source: IO[bytes], answers: IO[bytes]) -> None:
    """Load the model of the first frame and answer until the parent closes the input."""
    head, model = read_frame(source)
    resource.setrlimit(resource.RLIMIT_AS, (head["memory_bytes"],) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.setitimer(signal.ITIMER_REAL, head["load_s"])
    import numpy as np
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4
    try:
        session = onnxruntime.InferenceSession(
            bytes(model), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # onnxruntime's own exceptions share no public base
        write_frame(answers, {"error": _first_line(error), "version": onnxruntime.__version__})
        return
    del model
    about = {
        side: [[value.name, value.type, [_size(n) for n in value.shape or ()]] for value in values]
        for side, values in (("inputs", session.get_inputs()), ("outputs", session.get_outputs()))
    }
    signal.setitimer(signal.ITIMER_REAL, 0)
    write_frame(answers, about)
    wanted = [name for name, _, _ in about["outputs"]]
    while True:
        try:
            asked, data = read_frame(source)
        except EOFError:
            return
        signal.setitimer(signal.ITIMER_REAL, head["answer_s"])
        feed, at = {}, 0
        for name, shape in asked["arrays"]:
            count = math.prod(shape)
            feed[name] = np.frombuffer(data, np.float32, count, at).reshape(shape)
            at += 4 * count
        try:
            found = [np.ascontiguousarray(value) for value in session.run(wanted, feed)]
        except Exception as error:
            write_frame(answers, {"error": _first_line(error)})
            continue
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        shapes = [[name, list(v.shape)] for name, v in zip(wanted, found, strict=True)]
        write_frame(answers, {"arrays": shapes}, *found)


def _size(size: Any) -> int | None:
    return size if isinstance(size, int) else None


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]


if __name__ == "__main__":
    # What native libraries print must not come between the answers.
    to_parent = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    try:
        serve(os.fdopen(0, "rb", buffering=0), to_parent)
    except BrokenPipeError:
        sys.exit(1)

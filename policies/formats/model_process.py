"""Run a foreign model in its own process, so that its endless loop or crash does not end the suite.

A model made outside the suite is a program: an ONNX node can loop 2^62 times, even while the file
loads; TorchScript and C have loops too. So onnxruntime, torch and a compiled policy.c run in a
process with limits of time and memory (`model_server.py`), which is killed when it exceeds them.
This protects against errors, not against attacks: torch files and C can run any code.
"""

from __future__ import annotations

import json
import signal
import socket
import struct
import subprocess
import sys
import time
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from policies.formats.model_server import KINDS, data_bytes
from policies.spec import NoAnswer, PolicyError
from tracks.common.work.processes import end_process

LOAD_S = 60.0
"""Time limit to start, load and optimise the model [s]."""
ANSWER_S = 60.0
"""Time limit for one block of rows [s]; the judge's own deadline is shorter."""
MEMORY_BYTES = 4 * 2**30
"""Largest address space of the process, in addition to that of the engine [bytes]."""
ANSWER_BYTES = 2**28
"""Size of the largest answer [bytes]."""
GRACE_S = 5.0
"""Time after a limit at which the process ends itself, in case its parent has ended [s]."""
SERVER = Path(__file__).with_name("model_server.py")
"""The program that runs in the process."""
REMEDIES = {
    "onnxruntime": "export it for an older opset",
    "torch": "export it again with this version of torch",
    "ctypes": "it must define policy_reset and policy_step as its policy.h declares them",
}
"""Python module that runs a model (engine) -> advice if it refuses the model."""
ENGINE_NAMES = {"ctypes": "compiled C"}
"""Python module that runs a model (engine) -> its name in messages, if different."""


class Port(NamedTuple):
    """An input or an output of a model."""

    name: str
    kind: str
    """Type as named by onnxruntime, such as tensor(float); empty for torch."""
    shape: tuple[int | None, ...]
    """Size of each axis, None for an axis of any size; empty for TorchScript, which does not store
    it."""


class ModelProcess:
    """A loaded model in its own process, which ends with this object.

    A process that does not answer in time is killed; the next call starts a new one.
    """

    def __init__(self, model: bytes, where: str, kind: str, labels: Sequence[str] = ()) -> None:
        """Start the process and load the model there.

        The model is the bytes of a file, or the path of a C library; its kind is in
        `model_server.KINDS`. `labels` are names of the texts in a torch file; for a C library one
        name, for its JSON.

        Raises:
            PolicyError: where the engine refuses it, or exceeds its limits.
        """
        self._where, self._model = where, model
        self._module, self._kind, self._labels = KINDS[kind][0], kind, list(labels)
        self._engine = ENGINE_NAMES.get(self._module, self._module)
        description = self._start()
        self.labels: dict[str, str | bytes] = description.get("labels", {})
        """Texts of the file by name."""
        self.sizes: list[int] = description.get("sizes", [])
        """For a C library: size of its state [bytes], sizes of its observation and action."""
        self.inputs, self.outputs = (
            [Port(name, kind, tuple(shape)) for name, kind, shape in description[side]]
            for side in ("inputs", "outputs")
        )

    def _start(self) -> dict[str, Any]:
        """Start the process, load the model there and return its description."""
        # A socket instead of pipes, because it has timeouts.
        self._socket, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", str(SERVER)],
                stdin=theirs.fileno(),
                stdout=theirs.fileno(),
                stderr=subprocess.DEVNULL,
                # Ctrl-C reaches all processes of a session; this process decides when it ends.
                start_new_session=True,
            )
        self._end = weakref.finalize(self, _end, self._process, self._socket)
        limits = {
            "memory_bytes": MEMORY_BYTES,
            "load_s": LOAD_S + GRACE_S,
            "answer_s": ANSWER_S + GRACE_S,
        }
        header = {"bytes": len(self._model), "kind": self._kind, "labels": self._labels, **limits}
        description, _ = self._request(header, [self._model], LOAD_S)
        if "error" in description:
            raise PolicyError(
                f"{self._where}: {self._engine} {description['version']} cannot load it "
                f"({description['error']}); {REMEDIES[self._module]}"
            )
        return description

    def run(self, feed: dict[str, np.ndarray]) -> list[np.ndarray]:
        """Return the model's outputs, float32, for its inputs in order.

        Raises:
            NoAnswer: where the model fails, or exceeds its limits.
        """
        if not self._end.alive:
            self._start()
        arrays = {name: np.ascontiguousarray(value, np.float32) for name, value in feed.items()}
        header = {"arrays": [[name, value.shape] for name, value in arrays.items()]}
        data = [value.reshape(-1).view(np.uint8).data for value in arrays.values() if value.size]
        answer, buffer = self._request(header, data, ANSWER_S)
        if "error" in answer:
            raise NoAnswer(
                f"{self._where}: fails while it runs ({answer['error']}); correct it and export "
                "it again"
            )
        outputs, offset = [], 0
        for _, shape in answer["arrays"]:
            count = int(np.prod(shape, dtype=np.int64))
            outputs.append(np.frombuffer(buffer, np.float32, count, offset).reshape(shape))
            offset += 4 * count
        return outputs

    def _request(
        self, header: dict[str, Any], data: list[Any], limit_s: float
    ) -> tuple[dict[str, Any], bytearray]:
        """Send a frame (see `model_server.py`), and return header and data of the answer."""
        until = time.monotonic() + limit_s
        text = json.dumps(header).encode()
        try:
            for part in (struct.pack("<I", len(text)) + text, *data):
                self._socket.settimeout(_remaining_s(until))
                self._socket.sendall(part)
            (length,) = struct.unpack("<I", self._read(4, until))
            answer = json.loads(self._read(length, until))
            return answer, self._read(data_bytes(answer), until)
        except TimeoutError:
            text = (
                f"gave no answer within {limit_s:g} s: the machine is busy, or the policy loops "
                "without end; repeat it on a free machine, and check the policy for endless loops"
            )
        except (ConnectionError, EOFError, ValueError, MemoryError):
            text = (
                f"{_how_it_ended(self._process)}; repeat it, and if this happens again, check the "
                "free memory, and the policy's sizes and code"
            )
        self._end()
        raise NoAnswer(f"{self._where}: the process that runs it with {self._engine} {text}")

    def _read(self, count: int, until: float) -> bytearray:
        """Read `count` bytes from the process, or raise a TimeoutError at the time `until`."""
        if not 0 <= count <= ANSWER_BYTES:
            raise ValueError(f"an answer of {count} bytes")
        data = bytearray(count)
        view = memoryview(data)
        while view:
            self._socket.settimeout(_remaining_s(until))
            if not (got := self._socket.recv_into(view)):
                raise EOFError
            view = view[got:]
        return data


def _end(process: subprocess.Popen[bytes], connection: socket.socket) -> None:
    """End the process and the connection to it."""
    end_process(process)
    connection.close()


def _remaining_s(until: float) -> float:
    """Return the time to `until` [s], or raise a TimeoutError if it is over."""
    if (remaining_s := until - time.monotonic()) <= 0.0:
        raise TimeoutError
    return remaining_s


def _how_it_ended(process: subprocess.Popen[bytes]) -> str:
    """Return a text, without its subject, on why the process gave no answer."""
    try:
        code = process.wait(1.0)
    except subprocess.TimeoutExpired:
        return "gave an answer that is not valid"
    return f"ended by {signal.Signals(-code).name}" if code < 0 else f"ended with code {code}"

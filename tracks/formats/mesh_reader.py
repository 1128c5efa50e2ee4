"""Read untrusted mesh files in a separate process with limits of time and memory.

A small mesh file may refer to files that never end, or unpack to more than the memory. The process
returns only the triangles' coordinates. It is kept for the next track, and ends by itself when it
was not used for a while.
"""

from __future__ import annotations

import atexit
import functools
import json
import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from tracks.common.work.processes import end_process
from tracks.input.reading import MESH_BYTES, check_file

KINDS = (".obj", ".stl", ".ply", ".off", ".glb", ".gltf")
"""Allowed endings of file names; archives are not read."""
READ_S = 60.0
"""Time limit for all files of a track [s]."""
IDLE_S = 30.0
"""Time after its last use at which the process ends [s]."""
MEMORY_BYTES = 3 * 2**30
"""Largest address space of the process, libraries included [bytes]."""
_PROGRAM = (
    "import sys; sys.path.append(sys.argv[1]); "
    "from tracks.formats.mesh_reader import serve; serve()"
)
"""Program of the reading process; its argument is the folder of the code."""


def load_convex_parts(paths: Sequence[Path]) -> list[list[np.ndarray]]:
    """Return the result of `convex_parts.convex_parts` for each mesh file.

    Raises:
        ValueError: where a file cannot be read, a part is open or not convex, or reading takes too
            long or too much memory; the message names the file.
    """
    for path in paths:
        if path.suffix.lower() not in KINDS:
            raise ValueError(f"{path}: a mesh file's name must end in one of {', '.join(KINDS)}")
        if not path.exists():
            raise ValueError(f"{path}: no such mesh file; paths are relative to the track's file")
        check_file(path, MESH_BYTES)
    if not paths:
        return []
    names = ", ".join(map(str, paths[:3])) + (", ..." if len(paths) > 3 else "")
    with _one_at_a_time:
        header, data = _request([os.fspath(path.absolute()) for path in paths], names)
    if "error" in header:
        raise ValueError(header["error"])
    triangles = np.frombuffer(data).reshape(-1, 3, 3)
    sizes = header["sizes"]  # triangles of each part, for each file
    parts = iter(np.split(triangles, np.cumsum([n for file_sizes in sizes for n in file_sizes])))
    return [[next(parts) for _ in file_sizes] for file_sizes in sizes]


_one_at_a_time = threading.Lock()


@functools.cache
def _process() -> subprocess.Popen[bytes]:
    """Start the reading process, once, and return it."""
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", _PROGRAM, str(Path(__file__).resolve().parents[2])],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C must reach only this process
    )
    atexit.register(end_process, process)
    return process


def _request(paths: list[str], names: str) -> tuple[dict[str, Any], bytes]:
    """Send paths to the reading process; return the header and the data of its answer.

    Raises:
        ValueError: where the process does not answer in time, or ends.
    """
    if _process().poll() is not None:
        end_process(_process())
        _process.cache_clear()
    process = _process()
    timer = threading.Timer(READ_S, process.kill)
    timer.start()
    try:
        return _exchange(process, paths)
    except (EOFError, BrokenPipeError):
        late = f"within {READ_S:g} s" if timer.finished.is_set() else ""
    except BaseException:  # Ctrl-C: a late answer would be read as that of the next request
        process.kill()
        raise
    finally:
        timer.cancel()
    if process.wait() == -signal.SIGALRM:  # its idle time ended at this moment
        return _request(paths, names)
    how = late or f"to the end, its reader ended with {process.returncode}"
    raise ValueError(f"{names}: cannot be read as a mesh {how}; use a simpler one")


def _exchange(process: subprocess.Popen[bytes], paths: list[str]) -> tuple[dict[str, Any], bytes]:
    """Write a request to the process, and return the header and the data that it writes."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(json.dumps(paths).encode() + b"\n")
    process.stdin.flush()
    line = process.stdout.readline()
    header = json.loads(line) if line.endswith(b"\n") else {"bytes": -1}
    data = process.stdout.read(max(header["bytes"], 0))
    if len(data) != header["bytes"]:
        process.kill()
        raise EOFError
    return header, data


def serve() -> None:
    """Run the reading process: each input line is a JSON list of paths, each output an answer.

    An answer is a line with a JSON header, followed by the corners of the triangles as float64.
    """
    # Libraries may print; their output goes to standard error, so that it cannot mix with answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    import trimesh  # noqa: F401  # imported before the memory limit is set

    from tracks.formats.convex_parts import convex_parts

    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    while line := sys.stdin.readline():
        signal.setitimer(signal.ITIMER_REAL, READ_S + 5.0)  # in case the parent has ended
        parts, path = [], ""
        try:
            for path in json.loads(line):
                parts.append(convex_parts(Path(path)))
        except ValueError as error:
            _answer(answers, {"error": str(error)}, [])
        except MemoryError:
            memory_text = f"{MEMORY_BYTES / 2**30:g} GB of memory"
            _answer(
                answers, {"error": f"{path}: takes more than {memory_text}; use a simpler mesh"}, []
            )
        else:
            sizes = [[len(part) for part in file_parts] for file_parts in parts]
            _answer(answers, {"sizes": sizes}, [p for file_parts in parts for p in file_parts])
        signal.setitimer(signal.ITIMER_REAL, IDLE_S)


def _answer(file: IO[bytes], header: dict[str, Any], parts: list[np.ndarray]) -> None:
    data = b"".join(np.ascontiguousarray(part, float).tobytes() for part in parts)
    file.write(json.dumps(header | {"bytes": len(data)}).encode() + b"\n" + data)
    file.flush()

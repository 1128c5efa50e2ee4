"""Read untrusted mesh files in a separate process with limits, which can be killed.

A mesh of few bytes may refer to files that never end, or unpack to more than the memory. The
process answers with numbers alone. It is kept for the next track, and ends by itself when it was
not needed for a while.
"""

from __future__ import annotations

import atexit
import contextlib
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

from tracks.input.reading import MESH_BYTES, check_file

KINDS = (".obj", ".stl", ".ply", ".off", ".glb", ".gltf")
"""Endings of the files that are read; archives are not."""
READ_S = 60.0
"""All files of a track are read within this time [s]."""
IDLE_S = 30.0
"""The process waits so long for another track [s]."""
MEMORY_BYTES = 3 * 2**30
"""Addresses that the process may use, libraries included."""
_PROGRAM = (
    "import sys; sys.path.append(sys.argv[1]); "
    "from tracks.formats.mesh_reader import serve; serve()"
)


def load_convex_parts(paths: Sequence[Path]) -> list[list[np.ndarray]]:
    """Return the result of `convex_parts.convex_parts` for each mesh file.

    Raises:
        ValueError: where a file cannot be read, or a part is open or not convex, naming both;
            where reading takes too long or too much memory.
    """
    for path in paths:
        if path.suffix.lower() not in KINDS:
            raise ValueError(f"{path}: a mesh file's name must end in one of {', '.join(KINDS)}")
        if not path.exists():
            raise ValueError(f"{path}: no such mesh file")
        check_file(path, MESH_BYTES)
    if not paths:
        return []
    names = ", ".join(map(str, paths[:3])) + (", ..." if len(paths) > 3 else "")
    with _one_at_a_time:
        found, data = _ask([os.fspath(path.absolute()) for path in paths], names)
    if "error" in found:
        raise ValueError(found["error"])
    triangles = np.frombuffer(data).reshape(-1, 3, 3)
    parts = iter(np.split(triangles, np.cumsum([n for each in found["sizes"] for n in each])))
    return [[next(parts) for _ in each] for each in found["sizes"]]


_one_at_a_time = threading.Lock()


@functools.cache
def _process() -> subprocess.Popen[bytes]:
    """Start the process that reads, once."""
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", _PROGRAM, str(Path(__file__).resolve().parents[2])],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for us
    )
    atexit.register(_end, process)
    return process


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(BrokenPipeError):  # unsent data is discarded
                pipe.close()
    process.wait()


def _ask(paths: list[str], names: str) -> tuple[dict[str, Any], bytes]:
    """Return the head and the data of the answer.

    Raises:
        ValueError: where there is none.
    """
    if _process().poll() is not None:
        _end(_process())
        _process.cache_clear()
    process = _process()
    late = threading.Timer(READ_S, process.kill)
    late.start()
    try:
        return _answer_of(process, paths)
    except (EOFError, BrokenPipeError):
        late_s = f"within {READ_S:g} s" if late.finished.is_set() else ""
    except BaseException:  # Ctrl-C: a later answer would be read as the next one
        process.kill()
        raise
    finally:
        late.cancel()
    if process.wait() == -signal.SIGALRM:  # it stopped waiting for us at this moment
        return _ask(paths, names)
    how = late_s or f"to the end, its reader ended with {process.returncode}"
    raise ValueError(f"{names}: cannot be read as a mesh {how}; use a simpler one")


def _answer_of(process: subprocess.Popen[bytes], paths: list[str]) -> tuple[dict[str, Any], bytes]:
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(json.dumps(paths).encode() + b"\n")
    process.stdin.flush()
    line = process.stdout.readline()
    found = json.loads(line) if line.endswith(b"\n") else {"bytes": -1}
    data = process.stdout.read(max(found["bytes"], 0))
    if len(data) != found["bytes"]:
        process.kill()
        raise EOFError
    return found, data


def serve() -> None:
    """Be the process that reads: lines of paths on the input, frames of triangles on the output."""
    # What libraries print must not come into the answers.
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    import trimesh  # noqa: F401  # before the limit, not once a file

    from tracks.formats.convex_parts import convex_parts

    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    while line := sys.stdin.readline():
        signal.setitimer(signal.ITIMER_REAL, READ_S + 5.0)  # in case the parent is gone
        parts, path = [], ""
        try:
            for path in json.loads(line):
                parts.append(convex_parts(Path(path)))
        except ValueError as error:
            _answer(answers, {"error": str(error)}, [])
        except MemoryError:
            most = f"{MEMORY_BYTES / 2**30:g} GB of memory"
            _answer(answers, {"error": f"{path}: takes more than {most}; use a simpler mesh"}, [])
        else:
            sizes = [[len(part) for part in each] for each in parts]
            _answer(answers, {"sizes": sizes}, [part for each in parts for part in each])
        signal.setitimer(signal.ITIMER_REAL, IDLE_S)


def _answer(file: IO[bytes], head: dict[str, Any], parts: list[np.ndarray]) -> None:
    data = b"".join(np.ascontiguousarray(part, float).tobytes() for part in parts)
    file.write(json.dumps(head | {"bytes": len(data)}).encode() + b"\n" + data)
    file.flush()

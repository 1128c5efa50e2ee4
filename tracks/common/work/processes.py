"""Run pieces of work in several processes of this machine.

It uses `concurrent.futures` with one pool for each process. Such a pool can be bound to cores,
ended at once, and restarted when its process has died.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, TypeVar

from tracks.common.files import naming
from tracks.common.work.pickling import (
    Failure,
    WorkerDied,
    failure,
    pack,
    register_dict_views,
    remote_error,
    unpack,
)
from tracks.common.work.threads import core_shares, usable_cores

Piece = TypeVar("Piece")
Result = TypeVar("Result")

REPORT_S = 0.2
"""Time between two returns of results [s]; a return takes about a millisecond."""
TRIES = 2
"""Number of attempts at a piece, if its process dies."""


@dataclass
class _Pending:
    """A piece that a process works on."""

    number: int
    packed: bytes
    """The work and the piece, for another attempt."""
    tries: int = 1


class _Process:
    """A pool of one process."""

    def __init__(self, cores: list[int]) -> None:
        self._cores = cores
        self.begin()

    def begin(self) -> None:
        """Start or restart the process."""
        existing = set(multiprocessing.active_children())
        self.pool = worker_pool(1, self._cores)
        self.pool.submit(usable_cores)  # starts it
        self._processes = set(multiprocessing.active_children()) - existing

    def end(self) -> str:
        """End the process, and return its exit code."""
        for process in self._processes:
            process.terminate()
        self.pool.shutdown(cancel_futures=True)
        codes = {p.exitcode for p in self._processes if p.exitcode} - {-signal.SIGTERM}
        return ", ".join(map(str, sorted(codes))) or "unknown"


def run_in_processes(
    work: Callable[[Piece], Iterable[Result]],
    pieces: Iterable[Piece],
    count: int,
    keep: Callable[[int, Result], None],
    pinned: bool,
) -> None:
    """Run `tracks.common.work.run_pieces` in `count` processes of this machine."""
    processes: list[_Process] = []
    try:
        for cores in core_shares(count) if pinned else [[]] * count:
            processes.append(_Process(cores))
        _collect(work, pieces, processes, keep)
    finally:
        for process in processes:
            process.end()


def _collect(
    work: Callable[[Piece], Iterable[Result]],
    pieces: Iterable[Piece],
    processes: list[_Process],
    keep: Callable[[int, Result], None],
) -> None:
    """Collect results from every process until all pieces are done."""
    waiting = iter(enumerate(pieces))
    pending: dict[Future[tuple[bytes, bool]], tuple[_Process, _Pending]] = {}

    def start_next(process: _Process) -> None:
        for number, piece in waiting:
            submit(process, _Pending(number, pack((work, piece))), is_new=True)
            return

    def submit(process: _Process, entry: _Pending, is_new: bool) -> None:
        try:
            future = process.pool.submit(_work_on, *([entry.packed] if is_new else []))
        except BrokenProcessPool:
            repeat(process, entry)
        else:
            pending[future] = process, entry

    def repeat(process: _Process, entry: _Pending) -> None:
        code = process.end()
        if entry.tries == TRIES:
            raise WorkerDied(
                f"a process died (exit code {code}), and so did the process that repeated its "
                "piece; out of memory? Work with fewer processes."
            )
        process.begin()
        entry.tries += 1
        submit(process, entry, is_new=True)

    for process in processes:
        start_next(process)
    while pending:
        for future in wait(pending, return_when=FIRST_COMPLETED).done:
            process, entry = pending.pop(future)
            try:
                packed, has_more = future.result()
            except BrokenProcessPool:
                repeat(process, entry)
                continue
            results = unpack(packed)
            if isinstance(results, Failure):
                raise remote_error(results)
            if has_more:
                submit(process, entry, is_new=False)
            else:
                start_next(process)
            for result in results:
                keep(entry.number, result)


_results: Iterator[Any] = iter(())
"""In a worker process: the remaining results of its piece."""


def _work_on(packed: bytes | None = None) -> tuple[bytes, bool]:
    """Return the next results (packed), and whether more follow.

    Errors are returned as results, since an error that cannot be pickled would end this process.
    `packed` has the work and a new piece; None: go on with the current piece.
    """
    global _results
    try:
        if packed is not None:
            work, piece = unpack(packed)
            _results = iter(work(piece))
        results, until = [], time.monotonic() + REPORT_S
        for result in _results:
            results.append(result)
            if time.monotonic() > until:
                return pack(results), True
        return pack(results), False
    except Exception as error:
        return pack(failure(error)), False


def worker_pool(processes: int, cores: Sequence[int] = ()) -> ProcessPoolExecutor:
    """Return a pool of processes that ignore keyboard interrupts and end with this process.

    Each process may use the given cores; none given: all.
    """
    register_dict_views()
    # Spawned, as threads of JAX and MuJoCo do not survive a fork.
    context = multiprocessing.get_context("spawn")
    with naming("/dev/shm"):  # holds the locks between processes
        return ProcessPoolExecutor(processes, context, _become_worker, (cores,))


def _become_worker(cores: Sequence[int]) -> None:
    """Prepare this process, a worker: interrupts, cores, and its end with the parent."""
    # A keyboard interrupt reaches every process of the group; only the parent handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if cores:
        # Before JAX starts as many threads as there are cores.
        os.sched_setaffinity(0, cores)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def end_process(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and close its pipes; unsent data is discarded."""
    process.kill()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None:
            with contextlib.suppress(BrokenPipeError):
                pipe.close()
    process.wait()

"""Independent pieces of work, in this process or shared by several; results come as they end.

`work(piece)` is a function of its piece alone, and a piece is small and picklable: where it is
worked touches no result, and another engine (a cluster's) can stand behind `work_off` as well.
"""

from __future__ import annotations

import copyreg
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.reduction import ForkingPickler
from types import MappingProxyType
from typing import Any, TypeVar

Piece = TypeVar("Piece")
Result = TypeVar("Result")

REPORT_S = 0.2
"""A process hands over what has come up this often; a round trip costs it a millisecond [s]."""


class WorkerDied(RuntimeError):
    """A process that worked for this one was killed, or ended where it should not."""


def usable_cores() -> int:
    """Return how many processor cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def core_shares(workers: int) -> list[list[int]]:
    """Return the cores of each of `workers` processes; empty lists where a system cannot pin."""
    if not hasattr(os, "sched_getaffinity"):
        return [[] for _ in range(workers)]
    cores = sorted(os.sched_getaffinity(0))
    each = len(cores) // workers
    return [cores[k * each : (k + 1) * each] for k in range(workers)]


def work_off(
    work: Callable[[Piece], Iterable[Result]],
    pieces: Sequence[Piece],
    workers: int,
    keep: Callable[[int, Result], None],
    pinned: bool = False,
) -> None:
    """Call `keep(number, result)` with every result of work(pieces[number]), as they come.

    One worker is this process. More are processes of their own (spawned, as threads of JAX and
    MuJoCo do not survive a fork); each takes the next piece when it is through with its last. They
    end with this call, however it ends, and with this process.

    Args:
        work: a function at the top of a module, or a `functools.partial` of one.
        pieces: what to work on.
        workers: how many processes, at least 1.
        keep: called in this process; what it raises ends the work.
        pinned: give each process as many cores, and none of another's.

    Raises:
        ValueError: where `work` or a piece cannot travel.
        WorkerDied: where a process died, with its exit code and what to do.
        Exception: what `work` raises, as it was raised.
    """
    if workers == 1:
        for number, piece in enumerate(pieces):
            for result in work(piece):
                keep(number, result)
        return
    let_views_travel()
    try:
        ForkingPickler.dumps((work, pieces))
    except Exception as error:
        raise ValueError(
            f"cannot be sent to other processes ({error}); give functions at the top of a module "
            "and plain values (for a policy: functools.partial(load_policy, name)), or work in "
            "one process"
        ) from error
    shares = core_shares(workers) if pinned else [[]] * workers
    before = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    pools = [ProcessPoolExecutor(1, context, _start, (cores,)) for cores in shares]
    for pool in pools:
        pool.submit(usable_cores)  # starts its process
    processes = set(multiprocessing.active_children()) - before
    died = False
    try:
        _collect(work, pieces, pools, keep)
    except BrokenProcessPool:
        died = True
    finally:
        for process in processes:
            process.terminate()
        for pool in pools:
            pool.shutdown(cancel_futures=True)
    if died:
        codes = sorted({p.exitcode for p in processes if p.exitcode} - {-signal.SIGTERM})
        raise WorkerDied(
            f"a process died (exit code {', '.join(map(str, codes)) or 'unknown'}); out of memory? "
            "Work with fewer processes."
        )


def _collect(
    work: Callable[[Piece], Iterable[Result]],
    pieces: Sequence[Piece],
    pools: Sequence[ProcessPoolExecutor],
    keep: Callable[[int, Result], None],
) -> None:
    """Ask every pool, which is one process, for results until there is no more."""
    waiting = iter(enumerate(pieces))
    asked: dict[Future[tuple[list[Result], bool]], tuple[ProcessPoolExecutor, int]] = {}

    def begin(pool: ProcessPoolExecutor) -> None:
        for number, piece in waiting:
            asked[pool.submit(_work_on, work, piece)] = pool, number
            return

    for pool in pools:
        begin(pool)
    while asked:
        for future in wait(asked, return_when=FIRST_COMPLETED).done:
            pool, number = asked.pop(future)
            results, more = future.result()
            if more:
                asked[pool.submit(_work_on)] = pool, number
            else:
                begin(pool)
            for result in results:
                keep(number, result)


_results: Iterator[Any] = iter(())
"""In a process that works for another one: what is left of its piece."""


def _work_on(
    work: Callable[[Any], Iterable[Any]] | None = None, piece: Any = None
) -> tuple[list[Any], bool]:
    """Return the next results of the piece, of a new one where `work` is given; more to come?"""
    global _results
    if work is not None:
        _results = iter(work(piece))
    found, until = [], time.monotonic() + REPORT_S
    for result in _results:
        found.append(result)
        if time.monotonic() > until:
            return found, True
    return found, False


def _start(cores: list[int]) -> None:
    """Make this process a worker."""
    let_views_travel()
    # An interrupt from the keyboard goes to every process of the group; the first one decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if cores:
        # Before JAX makes its threads: there will be as many as cores.
        os.sched_setaffinity(0, cores)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def let_views_travel() -> None:
    """Let read-only views of dicts be pickled; a vehicle's effects are one."""
    copyreg.pickle(MappingProxyType, _reduce_view)


def _view(entries: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(entries)


def _reduce_view(view: MappingProxyType[Any, Any]) -> tuple[Any, ...]:
    return _view, (dict(view),)

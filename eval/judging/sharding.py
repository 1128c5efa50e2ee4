"""Work shared by processes: each gets its share at the start and sends results as they come."""

from __future__ import annotations

import copyreg
import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from types import MappingProxyType
from typing import Any

Emit = Callable[..., None]
Work = Callable[[Any, list[Any], Emit], None]


def usable_cores() -> int:
    """Return how many processor cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def fly_in_processes(work: Work, task: Any, items: list[Any], processes: int, emit: Emit) -> None:
    """Call `work(task, share, emit)` in several processes and `emit` here with what they send.

    Processes are spawned, not forked, as threads of JAX and MuJoCo do not survive a fork. Process
    k takes every item k, k + processes, ..., so that neighbouring items, which are alike, spread.

    Args:
        work: a function at the top of a module.
        task: what every share needs; must be picklable.
        items: to be shared out.
        processes: how many, at least 1.
        emit: called here, with the arguments of the calls there.

    Raises:
        ValueError: where the task cannot travel, or as raised by the work.
        RuntimeError: where a process died or its work failed otherwise.
        KeyboardInterrupt: passed on after the processes have been ended.
    """
    copyreg.pickle(MappingProxyType, _reduce_view)  # a vehicle's effects are one
    try:
        ForkingPickler.dumps(task)
    except Exception as error:
        raise ValueError(
            f"cannot be sent to other processes ({error}); give a function that makes the policy, "
            "such as functools.partial(load_policy, name), or fly with processes=1"
        ) from error
    context = multiprocessing.get_context("spawn")
    workers, pipes = [], []
    try:
        for number in range(processes):
            here, there = context.Pipe(duplex=False)
            worker = context.Process(
                target=_work, args=(work, task, items[number::processes], there), daemon=True
            )
            worker.start()
            there.close()  # so that a worker's death closes the pipe
            workers.append(worker)
            pipes.append(here)
        _receive(pipes, workers, emit)
    finally:
        for worker in workers:
            worker.terminate()
        for worker in workers:
            worker.join()


def _view(entries: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(entries)


def _reduce_view(view: MappingProxyType[Any, Any]) -> tuple[Any, ...]:
    return _view, (dict(view),)


def _receive(pipes: list[Connection], workers: list[Any], emit: Emit) -> None:
    open_pipes = dict(zip(pipes, workers, strict=True))
    while open_pipes:
        for pipe in wait(list(open_pipes)):
            assert isinstance(pipe, Connection)
            try:
                kind, content = pipe.recv()
            except EOFError:
                worker = open_pipes[pipe]
                worker.join()
                raise RuntimeError(
                    f"a process of the judge died (exit code {worker.exitcode}); out of memory? "
                    "Fly with fewer processes."
                ) from None
            if kind == "result":
                emit(*content)
            elif kind == "done":
                del open_pipes[pipe]
            elif kind == "refused":
                raise ValueError(content)
            else:
                raise RuntimeError(f"a process of the judge failed:\n{content}")


def _work(work: Work, task: Any, share: list[Any], pipe: Connection) -> None:
    # An interrupt from the keyboard goes to every process of the group; the first one decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        work(task, share, lambda *content: pipe.send(("result", content)))
        pipe.send(("done", None))
    except ValueError as error:
        pipe.send(("refused", str(error)))
    except Exception:
        pipe.send(("failed", traceback.format_exc()))

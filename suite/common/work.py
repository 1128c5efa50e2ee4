"""Do long jobs in parallel: in processes of this machine, or on a cluster.

A job is work whose product is a folder, such as one training. The user chooses the workers by the
option `--workers`: a number of processes, or the address of the scheduler of a cluster.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from queue import SimpleQueue
from typing import Annotated, Any, NamedTuple, TypeVar

import tyro

from suite.common.console import Console, Silent
from suite.common.errors import WorkFailed
from suite.common.options import Advanced
from suite.common.running.remote import Job, do_remotely, parcels, replace_content
from tracks.common.work import WorkerDied, Workers, read_workers, run_pieces, usable_cores
from tracks.common.work.threads import share_threads

Result = TypeVar("Result")
"""Type of the result of a job."""

WorkersOption = Advanced[
    Annotated[str | None, tyro.conf.arg(metavar="N|HOST:PORT", help_behavior_hint="")]
]
"""Type of the option `--workers`; `read_workers_option` reads it."""


def read_workers_option(text: str | None, whole_cores: bool = False) -> Workers | None:
    """Return the workers of the option `--workers`; None without it.

    With `whole_cores`, more processes than this machine has cores are refused, because each of them
    keeps a core busy.

    Raises:
        ValueError: with the option and what is allowed.
    """
    workers, cores = read_workers(text), usable_cores()
    if whole_cores and isinstance(workers, int) and workers > cores:
        raise ValueError(
            f"--workers is {workers}; allowed is 1 to {cores}, the number of cores, or the address "
            "of a cluster's scheduler"
        )
    return workers


def do_jobs(
    do: Callable[[Job, Console], Result],
    jobs: Sequence[Job],
    workers: Workers | None,
    console: Console,
    title: str,
) -> list[Result]:
    """Do all jobs, and return the result do(job, console) of each in order.

    Args:
        do: a function at the top of a module, or a `functools.partial` of one. It saves finished
            work in the job's folder, so that the call can be repeated after an interrupt. Its
            result must contain no path.
        jobs: the jobs; afterwards their folders have the products.
        workers: None or 1 is this process, on all cores. Several processes of this machine are
            pinned to separate cores. Processes of a cluster get the content of folders.
        console: shows the progress of all jobs together. In this process `do` gets it; in other
            processes `do` gets one that forwards its progress (on a cluster none).
        title: short description of the jobs.

    Raises:
        WorkFailed: if a process dies twice at the same job.
        ValueError: if the cluster cannot be used.
        Exception: from `do`.
    """
    if workers is None or workers == 1:
        return [do(job, console) for job in jobs]
    results: dict[int, Result] = {}
    shares = [0.0] * len(jobs)
    with console.progress(title, len(jobs)) as update:

        def keep(number: int, result: Any) -> None:
            """Store the result of a job, or show its progress."""
            if isinstance(result, _Share):
                shares[number] = max(shares[number], result.value)
            elif isinstance(workers, str):
                # From a cluster a result also has the files of the folder.
                results[number], files = result
                replace_content(jobs[number].folder, files)
                shares[number] = 1.0
            else:
                results[number], shares[number] = result, 1.0
            update(round(sum(shares), 2))

        try:
            if isinstance(workers, str):
                work = partial(do_remotely, partial(_do_silently, do))
                run_pieces(work, parcels(jobs), workers, keep)
            else:
                run_pieces(partial(_do_with_progress, do), jobs, workers, keep, pinned=True)
        except WorkerDied as error:
            raise WorkFailed(
                f"{title}: a process died; the products of the others are kept. Repeat the command "
                f"to continue, with --workers 1 in one process. Its message: {error}"
            ) from error
    return [results[number] for number in range(len(jobs))]


class _Share(NamedTuple):
    """Message of a worker process: the finished share of its job."""

    value: float


def _do_silently(do: Callable[[Job, Console], Result], job: Job) -> Result:
    """Do a job in a worker process, without output."""
    share_threads()
    return do(job, Silent())


def _do_with_progress(do: Callable[[Job, Console], Result], job: Job) -> Iterator[_Share | Result]:
    """Do a job in a worker process; yields its progress, and then its result.

    The job has a thread of its own, since its console cannot yield.
    """
    share_threads()
    messages: SimpleQueue[_Share | None] = SimpleQueue()
    with ThreadPoolExecutor(1) as thread:
        console = Silent(lambda done, total: messages.put(_Share(done / total)))
        result = thread.submit(do, job, console)
        result.add_done_callback(lambda _: messages.put(None))
        yield from iter(messages.get, None)
        yield result.result()

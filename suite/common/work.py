"""Long pieces of work in parallel: the option `--workers`, and jobs whose product is a folder."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Annotated, Any, TypeVar

import tyro

from suite.common.console import Console, Quiet, Update
from suite.common.errors import WorkFailed
from suite.common.options import Advanced
from suite.common.running.apart import Job, do_apart, fill, parcels
from tracks.common.work import WorkerDied, Workers, read_workers, run_pieces, usable_cores
from tracks.common.work.threads import share_threads

Result = TypeVar("Result")

WorkersOption = Advanced[
    Annotated[str | None, tyro.conf.arg(metavar="N|HOST:PORT", help_behavior_hint="")]
]
"""As a command's option; `workers_given` reads it."""


class Silent(Quiet):
    """Prints nothing: lines of parallel jobs would mix."""

    def note(self, text: str) -> None:
        """Print nothing."""

    @contextmanager
    def progress(
        self, label: str, total: float, clock: object = None, begun: float = 0.0
    ) -> Iterator[Update]:
        """Show nothing."""

        def update(done: float, note: str = "") -> None:
            del done, note

        yield update


def workers_given(text: str | None, whole_cores: bool = False) -> Workers | None:
    """Return the workers of the option `--workers`; None if it was not given.

    Args:
        text: the option.
        whole_cores: refuse more processes than this machine has cores, for work that keeps its
            cores busy.

    Raises:
        ValueError: with the option and what is allowed.
    """
    workers, cores = read_workers(text), usable_cores()
    if whole_cores and isinstance(workers, int) and workers > cores:
        raise ValueError(
            f"--workers is {workers}; allowed is 1 to {cores}, the cores there are, or the address "
            "of a cluster's scheduler"
        )
    return workers


def all_done(
    do: Callable[[Job, Console], Result],
    jobs: Sequence[Job],
    workers: Workers | None,
    console: Console,
    what: str,
) -> list[Result]:
    """Return do(job, console) of every job in order; the jobs' folders are as `do` leaves them.

    Args:
        do: a function at the top of a module, or a `functools.partial` of one. It saves finished
            work in the job's folder, so that the call can be repeated after an interrupt. Its
            result must contain no path.
        jobs: the work.
        workers: None or 1 is this process, on all cores. Several processes of this machine are
            pinned to separate cores; those of a cluster get folders as content.
        console: shows the number of finished jobs; `do` gets it in this process, and a silent one
            in others.
        what: short description of the jobs.

    Raises:
        WorkFailed: if a process dies twice at the same job.
        ValueError: if the cluster cannot be used.
        Exception: from `do`.
    """
    if workers is None or workers == 1:
        return [do(job, console) for job in jobs]
    found: dict[int, Result] = {}
    with console.progress(what, len(jobs)) as update:

        def keep(number: int, result: Any) -> None:
            if isinstance(workers, str):
                result, files = result
                fill(jobs[number].folder, files)
            found[number] = result
            update(len(found))

        try:
            if isinstance(workers, str):
                work = partial(do_apart, partial(_silently, do))
                run_pieces(work, parcels(jobs), workers, keep)
            else:
                run_pieces(partial(_yielded, do), jobs, workers, keep, pinned=True)
        except WorkerDied as error:
            raise WorkFailed(
                f"{what}: a process ended badly, what the others finished is kept; the same "
                f"command goes on, with --workers 1 in one process. It said: {error}"
            ) from error
    return [found[number] for number in range(len(jobs))]


def _silently(do: Callable[[Job, Console], Result], job: Job) -> Result:
    share_threads()
    return do(job, Silent())


def _yielded(do: Callable[[Job, Console], Result], job: Job) -> Iterator[Result]:
    yield _silently(do, job)

"""Long pieces of work side by side in processes, each on its own share of the cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

from rich.console import RenderableType

from eval.judging.sharding import fly_in_processes, usable_cores
from suite.common.console import Console, Update
from suite.common.errors import WorkFailed

Piece = TypeVar("Piece")
Result = TypeVar("Result")


class Silent(Console):
    """Says nothing: several at once would write into each other's lines."""

    def say(self, text: str = "") -> None:
        """Print nothing."""

    def show(self, table: RenderableType) -> None:
        """Print nothing."""

    def note(self, text: str) -> None:
        """Print nothing."""

    @contextmanager
    def progress(self, label: str, total: float, clock: object = None) -> Iterator[Update]:
        """Show nothing."""

        def update(done: float, note: str = "") -> None:
            del done, note

        yield update


def check_jobs(jobs: int) -> None:
    """Refuse a number of processes that would share cores.

    Raises:
        ValueError: naming the option and what is allowed.
    """
    cores = usable_cores()
    if not 1 <= jobs <= cores:
        raise ValueError(f"--jobs is {jobs}; allowed is 1 to {cores}, the cores there are")


def core_shares(jobs: int) -> list[list[int]]:
    """Return the cores of each of `jobs` processes; empty lists where a system cannot pin."""
    if not hasattr(os, "sched_getaffinity"):
        return [[] for _ in range(jobs)]
    cores = sorted(os.sched_getaffinity(0))
    each = len(cores) // jobs
    return [cores[k * each : (k + 1) * each] for k in range(jobs)]


def all_done(
    do: Callable[[Piece, Console], Result],
    pieces: Sequence[Piece],
    jobs: int,
    console: Console,
    what: str,
) -> list[Result]:
    """Return do(piece, console) of every piece, in order.

    Args:
        do: a function at the top of a module, or a `functools.partial` of one. It keeps what it
            has finished, so that an interrupted call can be made again.
        pieces: picklable.
        jobs: processes at a time; 1 works in this one, on all cores. More are pinned to as many
            cores each, and none to another's.
        console: told how many are done; `do` gets it where jobs is 1, and a silent one elsewhere.
        what: the pieces are, in a few words.

    Raises:
        WorkFailed: as `do` raises it, and where a process ends badly.
    """
    if jobs == 1:
        return [do(piece, console) for piece in pieces]
    shares, found = core_shares(jobs), {}
    items = [(number, shares[number % jobs], piece) for number, piece in enumerate(pieces)]
    with console.progress(what, len(pieces)) as update:

        def keep(number: int, result: Result | WorkFailed) -> None:
            if isinstance(result, WorkFailed):
                raise result
            found[number] = result
            update(len(found))

        try:
            fly_in_processes(_do_share, do, items, jobs, keep)
        except WorkFailed:
            raise
        except RuntimeError as error:
            raise WorkFailed(
                f"{what}: a process ended badly, what the others finished is kept; the same "
                f"command goes on, with --jobs 1 in one process. It said: {error}"
            ) from error
    return [found[number] for number in range(len(pieces))]


def _do_share(
    do: Callable[[Any, Console], Any],
    share: list[tuple[int, list[int], Any]],
    emit: Callable[[int, Any], None],
) -> None:
    for number, cores, piece in share:
        if cores:
            # Before JAX makes its threads: there will be as many as cores.
            os.sched_setaffinity(0, cores)
        try:
            emit(number, do(piece, Silent()))
        except WorkFailed as failure:
            emit(number, failure)

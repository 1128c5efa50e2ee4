"""Long pieces of work side by side in processes, each on its own share of the cores."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

from suite.common.console import Console, Quiet, Update
from suite.common.errors import WorkFailed
from suite.common.running.threads import share_threads
from tracks.common.work import WorkerDied, usable_cores, work_off

Piece = TypeVar("Piece")
Result = TypeVar("Result")


class Silent(Quiet):
    """Says nothing: several at once would write into each other's lines."""

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
        WorkFailed: where a process dies.
        Exception: what `do` raises.
    """
    if jobs == 1:
        return [do(piece, console) for piece in pieces]
    found: dict[int, Result] = {}
    with console.progress(what, len(pieces)) as update:

        def keep(number: int, result: Result) -> None:
            found[number] = result
            update(len(found))

        try:
            work_off(partial(_silently, do), pieces, jobs, keep, pinned=True)
        except WorkerDied as error:
            raise WorkFailed(
                f"{what}: a process ended badly, what the others finished is kept; the same "
                f"command goes on, with --jobs 1 in one process. It said: {error}"
            ) from error
    return [found[number] for number in range(len(pieces))]


def _silently(do: Callable[[Piece, Console], Result], piece: Piece) -> Iterator[Result]:
    share_threads()
    yield do(piece, Silent())

"""Independent pieces of work: here, in processes of this machine, or on a cluster.

`work(piece)` is a function of its piece alone, and a piece is small and travels by content: where
it is worked on touches no result. Who asks says only how many, or where.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

from tracks.common.work.threads import core_shares, usable_cores
from tracks.common.work.travel import WorkerDied

__all__ = [
    "MOST", "WorkerDied", "Workers", "core_shares", "crew", "read_workers", "usable_cores",
    "work_off",
]  # fmt: skip

Piece = TypeVar("Piece")
Result = TypeVar("Result")

Workers = int | str
"""So many processes of this machine, or the address of a cluster's scheduler."""
MOST = 256
"""Processes of this machine."""
_PROTOCOLS = ("tcp", "tls", "ws", "wss")


def read_workers(text: str | None, option: str = "--workers") -> Workers | None:
    """Return what `option` says, None where it was not given.

    Raises:
        ValueError: where it is neither a number of processes nor an address.
    """
    if text is None:
        return None
    if text.isascii() and text.isdigit() and 1 <= int(text[:6]) <= MOST:
        return int(text)
    protocol, apart, rest = text.rpartition("://")
    host, _, port = rest.rpartition(":")
    known = protocol in _PROTOCOLS if apart else True
    if known and host and port.isascii() and port.isdigit():
        return f"{protocol or 'tcp'}://{rest}"
    raise ValueError(
        f"{option} is {text[:80]!r}; allowed is 1 to {MOST}, processes of this machine, or the "
        "address of a cluster's scheduler such as tcp://10.0.0.1:8786"
    )


def crew(workers: Workers) -> int:
    """Return how many processes that is.

    Raises:
        ValueError: where there is no cluster at that address, or none that can work for us.
    """
    if isinstance(workers, int):
        return workers
    from tracks.common.work import cluster

    return cluster.size(workers)


def work_off(
    work: Callable[[Piece], Iterable[Result]],
    pieces: Iterable[Piece],
    workers: Workers,
    keep: Callable[[int, Result], None],
    pinned: bool = False,
) -> None:
    """Call `keep(number, result)` with every result of work(piece number `number`), as they come.

    One worker is this process. More are processes of their own, which end with this call, however
    it ends, and with this process; each takes the next piece when it is through with its last, and
    hands over results while it is at it. Those of a cluster hand them over at the end of a piece.
    What a worker had under way when it died is done again, once on this machine and three times on
    a cluster; of what it had handed over, `keep` then hears twice.

    Args:
        work: a function at the top of a module, or a `functools.partial` of one.
        pieces: what to work on, taken as workers come free.
        workers: how many processes of this machine, or where the cluster is.
        keep: called in this process; what it raises ends the work.
        pinned: give each process of this machine as many cores, and none of another's.

    Raises:
        ValueError: where `work` or a piece cannot travel, or there is no cluster that can work.
        WorkerDied: where a process died again over the same piece, with what to do.
        Exception: what `work` raises, as it was raised.
    """
    if workers == 1:
        for number, piece in enumerate(pieces):
            for result in work(piece):
                keep(number, result)
    elif isinstance(workers, int):
        from tracks.common.work import processes

        processes.share_out(work, pieces, workers, keep, pinned)
    else:
        from tracks.common.work import cluster

        cluster.share_out(work, pieces, workers, keep)

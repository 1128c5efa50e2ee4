"""Run independent pieces of work in this process, in several processes or on a cluster.

A piece is a small value that is sent to the process, such as the trials of one batch. `work(piece)`
depends on its piece alone, so where it runs does not change a result. The caller gives only the
number of processes, or the address of a cluster.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

from tracks.common.work.pickling import WorkerDied
from tracks.common.work.threads import core_shares, usable_cores

__all__ = [
    "MOST", "WorkerDied", "Workers", "core_shares", "worker_count", "read_workers", "usable_cores",
    "run_pieces",
]  # fmt: skip

Piece = TypeVar("Piece")
Result = TypeVar("Result")

Workers = int | str
"""Number of processes of this machine, or the address of a cluster's scheduler."""
MOST = 256
"""Largest number of processes of this machine."""
_PROTOCOLS = ("tcp", "tls", "ws", "wss")
"""Protocols of a cluster's address."""


def read_workers(text: str | None) -> Workers | None:
    """Return the value of the option `--workers`, None where it was not given.

    Raises:
        ValueError: where it is neither a number of processes nor an address.
    """
    if text is None:
        return None
    if text.isascii() and text.isdigit() and 1 <= int(text[:6]) <= MOST:
        return int(text)
    protocol, separator, location = text.rpartition("://")
    host, _, port = location.rpartition(":")
    known = protocol in _PROTOCOLS if separator else True
    if known and host and port.isascii() and port.isdigit():
        return f"{protocol or 'tcp'}://{location}"
    raise ValueError(
        f"--workers is {text[:80]!r}; allowed is 1 to {MOST}, processes of this machine, or the "
        "address of a cluster's scheduler such as tcp://10.0.0.1:8786"
    )


def worker_count(workers: Workers) -> int:
    """Return the number of processes.

    Raises:
        ValueError: where there is no usable cluster at that address.
    """
    if isinstance(workers, int):
        return workers
    from tracks.common.work import cluster

    return cluster.size(workers)


def run_pieces(
    work: Callable[[Piece], Iterable[Result]],
    pieces: Iterable[Piece],
    workers: Workers,
    keep: Callable[[int, Result], None],
    pinned: bool = False,
) -> None:
    """Call `keep(number, result)` with every result of piece `number`, in order of completion.

    One worker means this process. More workers are separate processes, which end with this call and
    with this process. A worker takes the next piece when it has finished one. On this machine it
    returns results while it works, on a cluster at the end of a piece. If a worker dies, its piece
    is repeated, once on this machine and up to three times on a cluster; `keep` may then be called
    twice with the same result.

    Args:
        work: a module-level function, or a `functools.partial` of one.
        pieces: the pieces; the next one is taken when a worker is free.
        workers: number of processes of this machine, or the cluster's address.
        keep: function that gets the results, in this process; an exception in it ends the work.
        pinned: whether each process of this machine runs on its own, equal share of the cores.

    Raises:
        ValueError: where `work` or a piece cannot be pickled, or there is no usable cluster.
        WorkerDied: where a process died twice with the same piece.
        Exception: any exception of `work`.
    """
    if workers == 1:
        for number, piece in enumerate(pieces):
            for result in work(piece):
                keep(number, result)
    elif isinstance(workers, int):
        from tracks.common.work import processes

        processes.run_in_processes(work, pieces, workers, keep, pinned)
    else:
        from tracks.common.work import cluster

        cluster.run_on_cluster(work, pieces, workers, keep)

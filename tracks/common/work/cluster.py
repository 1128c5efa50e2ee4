"""Pieces of work on the machines of a Dask cluster, whose scheduler deals them out.

Work and pieces travel as bytes, so a machine needs the same suite and no file of ours. The work
itself is the result of a task: every machine fetches it once, and where the machine that held it
dies the scheduler makes it anew, as it does the pieces that were under way there.

Dask's own messages hold pickles, which its client unpacks: who runs the scheduler or a worker can
run code in this process. Results are no safer than that, so they travel as pickles as well.
"""

from __future__ import annotations

import functools
import logging
import os
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

from tracks.common.work.threads import set_threads
from tracks.common.work.travel import (
    Failure,
    WorkerDied,
    differences,
    failure,
    pack,
    raised,
    software,
    unpack,
)

Piece = TypeVar("Piece")
Result = TypeVar("Result")

ANSWER_S = 10.0
"""A scheduler has this long to answer [s]."""
GRACE_S = 1.0
"""Later than that we stop waiting ourselves [s]."""
ALONE_S = 60.0
"""A scheduler may be without workers for this long [s]."""
AHEAD = 4
"""Pieces given to the scheduler for each worker: one is worked on, the others wait there."""
LEAST = 64
"""Pieces given to the scheduler at least; tiny ones would wait for the way otherwise."""
COUNT_S = 5.0
"""Workers come and go; they are counted this often [s]."""
ADVICE = (
    "on a machine with the suite and its extra `cluster`, `dask scheduler` starts one and "
    "`dask worker ADDRESS --nworkers N --nthreads 1` gives it N processes"
)
TLS_ADVICE = (
    "give this machine the scheduler's authority and a certificate with its key, as the "
    "environment's DASK_DISTRIBUTED__COMM__TLS__CA_FILE, ...__TLS__CLIENT__CERT and "
    "...__TLS__CLIENT__KEY (docs/scaling.md)"
)


class UnusableCluster(ValueError):
    """A cluster that is not there, or cannot work for us; the message says what to do."""


def size(address: str) -> int:
    """Return how many processes work in the cluster.

    Raises:
        UnusableCluster: where none answers at `address`, or it has no workers.
    """
    with _connected(address) as client:
        return len(client.nthreads())


def share_out(
    work: Callable[[Piece], Iterable[Result]],
    pieces: Iterable[Piece],
    address: str,
    keep: Callable[[int, Result], None],
) -> None:
    """Do what `tracks.common.work.work_off` says on the cluster at `address`."""
    with _connected(address) as client:
        run, waiting = uuid.uuid4().hex, iter(enumerate(pieces))
        body = client.submit(_body, pack((software(), work)), key=f"suite-{run}-work")
        # Where one machine alone held it, the scheduler would give that one most of the pieces.
        client.replicate([body])
        in_air: dict[Any, int] = {}
        ended: SimpleQueue[Any] = SimpleQueue()
        workers = _Count(client)

        def fill() -> None:
            window = max(AHEAD * workers(), LEAST)
            # Many at once cost the scheduler little more than one.
            room = window - len(in_air) if len(in_air) <= window // 2 else 0
            batch = list(islice(waiting, room))
            if not batch:
                return
            numbers, packed = zip(*((n, pack(piece)) for n, piece in batch), strict=True)
            keys = [f"suite-{run}-{n}" for n in numbers]
            # Of one priority: the piece that was given first is worked on first.
            with warnings.catch_warnings():
                # That a training's start is large to send is known: it travels once.
                warnings.simplefilter("ignore")
                futures = client.map(_work_on, packed, work=body, key=keys)
            for number, future in zip(numbers, futures, strict=True):
                in_air[future] = number
                future.add_done_callback(ended.put)

        fill()
        while in_air:
            futures = _next(ended, client, address)
            results = client.gather([f for f in futures if f.status == "finished"], errors="skip")
            _check(futures, address, in_air)
            numbers = [in_air.pop(future) for future in futures]
            del futures
            fill()
            for number, packed in zip(numbers, results, strict=True):
                found = unpack(packed)
                if isinstance(found, Failure):
                    raise raised(found)
                for result in found:
                    keep(number, result)


class _Count:
    """How many workers there are, asked now and then."""

    def __init__(self, client: Any) -> None:
        self._client, self._until, self._count = client, 0.0, 0

    def __call__(self) -> int:
        if time.monotonic() > self._until:
            self._count = len(self._client.nthreads())
            self._until = time.monotonic() + COUNT_S
        return self._count


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    """Be a client of the scheduler at `address`."""
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise UnusableCluster(
            f"--workers {address}: a cluster needs the package {error.name!r}: "
            "pip install 'diffracing-suite[cluster]'"
        ) from error
    # What goes wrong is raised; its log of what is mended without us is not for people.
    logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)
    logging.getLogger("tornado").setLevel(logging.CRITICAL + 1)
    met: SimpleQueue[Any] = SimpleQueue()

    def connect() -> None:
        try:
            client: Any = distributed.Client(address, timeout=ANSWER_S, set_as_default=False)
            met.put((client, client.nthreads()))
        except Exception as error:  # of whatever kind, by what the other side sends
            met.put(error)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # Beside this thread: it waits on a port that is silent for longer than it was told.
        threading.Thread(target=connect, daemon=True).start()
        try:
            found = met.get(timeout=ANSWER_S + GRACE_S)
        except Empty:
            found = TimeoutError()
    if isinstance(found, Exception):
        advice = TLS_ADVICE if address.startswith(("tls:", "wss:")) else ADVICE
        raise UnusableCluster(
            f"--workers {address}: no scheduler of a Dask cluster answers there; {advice}"
        ) from found
    client, threads = found
    try:
        if not threads:
            raise UnusableCluster(f"--workers {address}: the cluster has no workers; {ADVICE}")
        if max(threads.values()) > 1:
            raise UnusableCluster(
                f"--workers {address}: its workers have up to {max(threads.values())} threads, and "
                "our pieces want a process each; start them with --nthreads 1"
            )
        yield client
    finally:
        client.close(timeout=ANSWER_S)


def _next(ended: SimpleQueue[Any], client: Any, address: str) -> list[Any]:
    """Return what has ended, after waiting for it."""
    while True:
        try:
            futures = [ended.get(timeout=ALONE_S)]
            break
        except Empty:
            if client.status != "running" or not client.nthreads():
                raise WorkerDied(
                    f"the cluster at {address} has had no worker for {ALONE_S:.0f} s; what was "
                    "finished is kept, the same command goes on"
                ) from None
    while not ended.empty():
        futures.append(ended.get())
    return futures


def _check(futures: list[Any], address: str, in_air: dict[Any, int]) -> None:
    """Raise what the cluster itself could not do."""
    for future in futures:
        if future.status == "finished":
            continue
        error = future.exception() if future.status == "error" else None
        if isinstance(error, (ImportError, AttributeError)):
            raise UnusableCluster(
                f"--workers {address}: a worker cannot find what it should do ({error}); install "
                "the same version of the suite there, and the packages that it was extended by"
            )
        why = f": {error}" if error else ", or its scheduler is gone"
        raise WorkerDied(
            f"the cluster at {address} gave up piece {in_air[future]}{why}; what was finished is "
            "kept, the same command goes on"
        )


def _body(packed: bytes) -> bytes:
    """Be the task whose result is the work."""
    return packed


_one_at_a_time = threading.Lock()


def _work_on(piece: bytes, work: bytes) -> bytes:
    """Work a piece off in a worker of the cluster; return its results, or how it failed."""
    try:
        with _one_at_a_time:
            return pack(list(_unpacked(work)(unpack(piece))))
    except Exception as error:
        return pack(failure(error))


@functools.lru_cache(maxsize=4)
def _unpacked(packed: bytes) -> Callable[[Any], Iterable[Any]]:
    """Return the work, the same object for all of its pieces.

    Raises:
        UnusableCluster: where this machine would come to other numbers.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    set_threads()
    wanted, work = unpack(packed)
    if why := differences(software(), wanted):
        raise UnusableCluster(
            f"a worker on {os.uname().nodename} would come to other numbers ({why}); install the "
            "same versions there"
        )
    return work

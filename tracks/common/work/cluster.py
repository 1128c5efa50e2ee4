"""Run pieces of work on a Dask cluster, whose scheduler distributes them.

Work (the function) and pieces (its arguments) are sent as bytes, so a machine needs the same
version of the suite but no files. The function is sent as the result of a separate task, which
every machine fetches once. If a machine dies, the scheduler repeats its tasks.

Security: Dask's messages contain pickles, which its client unpacks, so the scheduler and the
workers can run any code in this process. Sending results as pickles adds no further risk.
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

from tracks.common.work.pickling import (
    Failure,
    WorkerDied,
    differences,
    failure,
    pack,
    remote_error,
    software,
    unpack,
)
from tracks.common.work.threads import set_threads

Piece = TypeVar("Piece")
Result = TypeVar("Result")

ANSWER_S = 10.0
"""Time limit for an answer of the scheduler [s]."""
GRACE_S = 1.0
"""Time after `ANSWER_S` until this process stops waiting, in case Dask exceeds that limit [s]."""
NO_WORKER_S = 60.0
"""Longest time without workers before the work ends with an error [s]."""
QUEUED_PER_WORKER = 4
"""Number of pieces that are submitted for each worker: one runs, the others wait."""
QUEUED_LEAST = 64
"""Least number of pieces that are submitted, so that workers do not wait for small pieces."""
COUNT_S = 5.0
"""Time between two counts of the workers [s]."""
ADVICE = (
    "on a machine with the suite and its extra `cluster`, `dask scheduler` starts one and "
    "`dask worker ADDRESS --nworkers N --nthreads 1` gives it N processes"
)
"""How to start a cluster, for messages."""
TLS_ADVICE = (
    "give this machine the scheduler's authority and a certificate with its key, as the "
    "environment's DASK_DISTRIBUTED__COMM__TLS__CA_FILE, ...__TLS__CLIENT__CERT and "
    "...__TLS__CLIENT__KEY (docs/scaling.md)"
)
"""How to connect to an encrypted scheduler, for messages."""


class UnusableCluster(ValueError):
    """A cluster that does not exist or is not usable; the message has the next step."""


def size(address: str) -> int:
    """Return the number of worker processes of the cluster.

    Raises:
        UnusableCluster: where no cluster answers at `address`, or it has no workers.
    """
    with _connected(address) as client:
        return len(client.nthreads())


def run_on_cluster(
    work: Callable[[Piece], Iterable[Result]],
    pieces: Iterable[Piece],
    address: str,
    keep: Callable[[int, Result], None],
) -> None:
    """Run `tracks.common.work.run_pieces` on the cluster at `address`."""
    with _connected(address) as client:
        run, waiting = uuid.uuid4().hex, iter(enumerate(pieces))
        body = client.submit(_body, pack((software(), work)), key=f"suite-{run}-work")
        # With one copy, the scheduler would give most pieces to the machine that has it.
        client.replicate([body])
        submitted: dict[Any, int] = {}
        ended: SimpleQueue[Any] = SimpleQueue()
        workers = _WorkerCount(client)

        def submit_more() -> None:
            most_queued = max(QUEUED_PER_WORKER * workers(), QUEUED_LEAST)
            # Submitting many at once takes little more time than one.
            free = most_queued - len(submitted) if len(submitted) <= most_queued // 2 else 0
            batch = list(islice(waiting, free))
            if not batch:
                return
            numbers, packed = zip(*((n, pack(piece)) for n, piece in batch), strict=True)
            keys = [f"suite-{run}-{n}" for n in numbers]
            # With equal priority, pieces run in the order of submission.
            with warnings.catch_warnings():
                # Dask warns about large pieces, such as a training's start, which is sent once.
                warnings.simplefilter("ignore")
                futures = client.map(_work_on, packed, work=body, key=keys)
            for number, future in zip(numbers, futures, strict=True):
                submitted[future] = number
                future.add_done_callback(ended.put)

        submit_more()
        while submitted:
            futures = _next_ended(ended, client, address)
            finished = [future for future in futures if future.status == "finished"]
            packed_results = client.gather(finished, errors="skip")
            errors = _errors(futures, address, submitted)
            numbers = [submitted.pop(future) for future in finished]
            del futures, finished  # the cluster keeps a result while a future refers to it
            if not errors:
                submit_more()
            # Finished pieces are kept before an error of another piece ends the work.
            for number, packed in zip(numbers, packed_results, strict=True):
                results = unpack(packed)
                if isinstance(results, Failure):
                    errors.append(remote_error(results))
                    continue
                for result in results:
                    keep(number, result)
            if errors:
                raise errors[0]


class _WorkerCount:
    """The number of workers of a cluster, counted again after `COUNT_S`."""

    def __init__(self, client: Any) -> None:
        self._client, self._until, self._count = client, 0.0, 0

    def __call__(self) -> int:
        if time.monotonic() > self._until:
            self._count = len(self._client.nthreads())
            self._until = time.monotonic() + COUNT_S
        return self._count


@contextmanager
def _connected(address: str) -> Iterator[Any]:
    """Connect to the scheduler at `address`."""
    try:
        import distributed
    except ModuleNotFoundError as error:
        raise UnusableCluster(
            f"--workers {address}: a cluster needs the package {error.name!r}: "
            "pip install 'diffracing-suite[cluster]'"
        ) from error
    # Errors are remote_error; the log of problems that Dask repairs itself is suppressed.
    logging.getLogger("distributed").setLevel(logging.CRITICAL + 1)
    logging.getLogger("tornado").setLevel(logging.CRITICAL + 1)
    answers: SimpleQueue[Any] = SimpleQueue()

    def connect() -> None:
        try:
            client: Any = distributed.Client(address, timeout=ANSWER_S, set_as_default=False)
            answers.put((client, client.nthreads()))
        except Exception as error:  # its class depends on what answers at the address
            answers.put(error)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # In a separate thread, because it may exceed its timeout on a silent port.
        threading.Thread(target=connect, daemon=True).start()
        try:
            answer = answers.get(timeout=ANSWER_S + GRACE_S)
        except Empty:
            answer = TimeoutError()
    if isinstance(answer, Exception):
        advice = TLS_ADVICE if address.startswith(("tls:", "wss:")) else ADVICE
        raise UnusableCluster(
            f"--workers {address}: no scheduler of a Dask cluster answers there; {advice}"
        ) from answer
    client, threads = answer
    try:
        if not threads:
            raise UnusableCluster(f"--workers {address}: the cluster has no workers; {ADVICE}")
        if max(threads.values()) > 1:
            raise UnusableCluster(
                f"--workers {address}: its workers have up to {max(threads.values())} threads, and "
                "each piece needs its own process; start them with --nthreads 1"
            )
        yield client
    finally:
        client.close(timeout=ANSWER_S)


def _next_ended(ended: SimpleQueue[Any], client: Any, address: str) -> list[Any]:
    """Wait for ended pieces, and return their futures."""
    while True:
        try:
            futures = [ended.get(timeout=NO_WORKER_S)]
            break
        except Empty:
            if client.status != "running" or not client.nthreads():
                raise WorkerDied(
                    f"the cluster at {address} has had no worker for {NO_WORKER_S:.0f} s; finished "
                    "work is kept, the same command continues"
                ) from None
    while not ended.empty():
        futures.append(ended.get())
    return futures


def _errors(futures: list[Any], address: str, submitted: dict[Any, int]) -> list[Exception]:
    """Return an error for each piece that the cluster gave up."""
    errors = list[Exception]()
    for future in futures:
        if future.status == "finished":
            continue
        error = future.exception() if future.status == "error" else None
        if isinstance(error, (ImportError, AttributeError)):
            text = (
                f"--workers {address}: a worker cannot import the work ({error}); install the same "
                "version of the suite there, and the packages that extend it"
            )
            errors.append(UnusableCluster(text))
            continue
        why = f": {error}" if error else ", or its scheduler has ended"
        text = (
            f"the cluster at {address} gave up piece {submitted[future]}{why}; finished work is "
            "kept, the same command continues"
        )
        errors.append(WorkerDied(text))
    return errors


def _body(packed: bytes) -> bytes:
    """Return the packed function; this is the task on which all other tasks depend."""
    return packed


_one_at_a_time = threading.Lock()


def _work_on(piece: bytes, work: bytes) -> bytes:
    """Run a piece in a worker of the cluster; return its results or its failure."""
    try:
        with _one_at_a_time:
            return pack(list(_unpacked(work)(unpack(piece))))
    except Exception as error:
        return pack(failure(error))


@functools.lru_cache(maxsize=4)
def _unpacked(packed: bytes) -> Callable[[Any], Iterable[Any]]:
    """Return the work, the same object for all of its pieces.

    Raises:
        UnusableCluster: where this machine's software differs.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    set_threads()
    required, work = unpack(packed)
    if why := differences(software(), required):
        raise UnusableCluster(
            f"a worker on {os.uname().nodename} would compute other numbers ({why}); install the "
            "same versions there"
        )
    return work

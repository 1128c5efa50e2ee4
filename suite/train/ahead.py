"""The worlds of the next iterations, sampled while the devices compute."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from itertools import islice

import jax

from suite.train.worlds import Worlds
from tracks.common.work import usable_cores
from tracks.common.work.processes import become_worker
from tracks.common.work.travel import let_views_travel


class WorldsAhead:
    """Samples worlds in a thread or, for an accelerator, in processes; a context manager.

    One core samples faster than the others train. An accelerator is so fast that every core
    samples for it, each the worlds of another iteration.
    """

    def __init__(self) -> None:
        self._depth = 1 if jax.default_backend() == "cpu" else max(2, usable_cores() - 1)

    def __enter__(self) -> WorldsAhead:
        self._pool: Executor = ThreadPoolExecutor(1)
        if self._depth > 1:
            let_views_travel()
            # A fork would have a copy of JAX whose threads are gone.
            spawned = multiprocessing.get_context("spawn")
            self._pool = ProcessPoolExecutor(self._depth, spawned, become_worker)
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def worlds(
        self, sample: Callable[[int], Worlds], first: int, end: int
    ) -> Iterator[tuple[int, Worlds]]:
        """Yield each iteration from `first` on, to before `end`, with its worlds.

        Args:
            sample: the worlds of an iteration; one that can be pickled.
            first: iteration.
            end: the iteration after the last.
        """
        numbers = iter(range(first, end))
        begun = deque(self._pool.submit(sample, k) for k in islice(numbers, self._depth))
        for iteration in range(first, end):
            worlds = begun.popleft().result()
            begun.extend(self._pool.submit(sample, k) for k in islice(numbers, 1))
            yield iteration, worlds

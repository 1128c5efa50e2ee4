"""How many cores there are, and how many threads XLA's CPU and numpy's products take.

XLA's are as many as cores, and at least two. Its matrix products (Eigen's) are cut into other
blocks where there is one thread than where there are several, and so add up in another order. With
two threads on a single core too, a training comes to the same bits on any number of cores; there it
costs about a tenth of the speed. Products that several threads would cut along their sums are cut
by us (`policies/networks/layers.py`).

The cores that this process may run on are counted here, too, and shared out among processes.
"""

from __future__ import annotations

import os
from collections.abc import MutableMapping

VARIABLE = "NPROC"
"""Of the environment; XLA reads it when JAX first looks for devices."""
LEAST, MOST = 2, 4096


def set_threads(environment: MutableMapping[str, str] | None = None) -> None:
    """Have XLA take a thread a core, and at least two, where nothing else was asked for.

    Args:
        environment: changed in place; that of this process if not given.

    Raises:
        ValueError: where another number was asked for that is none.
    """
    values = os.environ if environment is None else environment
    asked = values.setdefault(VARIABLE, str(_wanted()))
    # XLA would end the process without a word to a person.
    if not (asked.isascii() and asked.isdigit() and 1 <= int(asked[:5]) <= MOST):
        raise ValueError(
            f"{VARIABLE} is {asked[:40]!r} in the environment; allowed is 1 to {MOST}, threads of "
            "XLA: unset it, or give a number"
        )


def share_threads(environment: MutableMapping[str, str] | None = None) -> None:
    """Take no more threads than this process's share of the cores, after `set_threads`."""
    values = os.environ if environment is None else environment
    values[VARIABLE] = str(min(threads(values), _wanted()))


def threads(environment: MutableMapping[str, str] | None = None) -> int:
    """Return how many threads XLA has, or will have."""
    values = os.environ if environment is None else environment
    return int(values.get(VARIABLE) or usable_cores())


def one_thread_a_product(environment: MutableMapping[str, str] | None = None) -> None:
    """Have numpy and scipy multiply matrices on one thread, where nothing else was asked for.

    Ours are many and small: threads gain nothing on free cores, and where a core is busy they wait
    for each other, ten to a hundred times as long as the product takes. numpy reads the setting
    when it is imported: call this before.

    Args:
        environment: changed in place; that of this process if not given.
    """
    values = os.environ if environment is None else environment
    if not {"OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"} & set(values):
        values["OPENBLAS_NUM_THREADS"] = "1"


def _wanted() -> int:
    return max(LEAST, usable_cores())


def usable_cores() -> int:
    """Return how many processor cores this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def core_shares(workers: int) -> list[list[int]]:
    """Return the cores of each of `workers` processes; empty lists where a system cannot pin."""
    if not hasattr(os, "sched_getaffinity"):
        return [[] for _ in range(workers)]
    cores = sorted(os.sched_getaffinity(0))
    each = len(cores) // workers
    return [cores[k * each : (k + 1) * each] for k in range(workers)]

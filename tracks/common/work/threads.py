"""Set the numbers of threads of XLA (JAX's compiler) and numpy, and count the usable cores.

XLA gets a thread for each core, and at least two. With one thread its matrix products (of the
library Eigen) are divided into other blocks than with several threads, and are summed in another
order. With at least two threads, a training gives the same bits on any number of cores; on a single
core it is about a tenth slower. `policies/networks/layers.py` splits those products whose sums XLA
would divide among threads.
"""

from __future__ import annotations

import os

VARIABLE = "NPROC"
"""Environment variable that XLA reads when JAX first lists its devices."""
LEAST, MOST = 2, 4096
"""Least number of threads that the suite sets, and largest number that the variable may have."""


def set_threads() -> None:
    """Set XLA's threads to the number of cores, and at least two, unless the variable is set.

    Raises:
        ValueError: where the variable is set to an invalid value.
    """
    setting = os.environ.setdefault(VARIABLE, str(_default_threads()))
    # XLA would end the process without a useful message.
    if not (setting.isascii() and setting.isdigit() and 1 <= int(setting[:5]) <= MOST):
        raise ValueError(
            f"{VARIABLE} is {setting[:40]!r} in the environment; allowed is 1 to {MOST} threads of "
            "XLA: unset it, or give a number"
        )


def share_threads() -> None:
    """Limit the threads to this process's share of the cores, after `set_threads`."""
    os.environ[VARIABLE] = str(min(threads(), _default_threads()))


def threads() -> int:
    """Return the number of XLA's threads."""
    return int(os.environ.get(VARIABLE) or usable_cores())


def one_thread_a_product() -> None:
    """Set numpy's and scipy's matrix products to one thread, unless a variable is set.

    The suite computes many small products. On free cores, threads do not make them faster. On busy
    cores, threads wait for each other ten to a hundred times as long as a product takes. Call this
    function before numpy is imported, because numpy reads the setting then.
    """
    if not {"OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"} & set(os.environ):
        os.environ["OPENBLAS_NUM_THREADS"] = "1"


def _default_threads() -> int:
    return max(LEAST, usable_cores())


def usable_cores() -> int:
    """Return the number of processor cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def core_shares(workers: int) -> list[list[int]]:
    """Return the core numbers for each of `workers` processes, in equal shares.

    The lists are empty on systems that cannot bind a process to cores.
    """
    if not hasattr(os, "sched_getaffinity"):
        return [[] for _ in range(workers)]
    cores = sorted(os.sched_getaffinity(0))
    share_size = len(cores) // workers
    return [cores[k * share_size : (k + 1) * share_size] for k in range(workers)]

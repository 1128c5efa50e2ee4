"""How many threads a process takes for numpy's products of matrices."""

from __future__ import annotations

import os
from collections.abc import MutableMapping


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

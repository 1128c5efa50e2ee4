"""One command in several JAX processes, on one machine or many.

All processes run the same command. JAX connects them through the first one, the coordinator, which
writes the files; the others need no access to its folders.
"""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

from suite.common.errors import WorkFailed
from tracks.common.files import to_json
from tracks.input.ranges import Range

COME_S = 300
"""Time for all processes to connect [s]."""
SILENT_S = 60
"""A process without a heartbeat for this time counts as ended [s]."""
ENVIRONMENTS = (
    ("SLURM_PROCID", "SLURM_NTASKS", "SLURM_STEP_NODELIST"),
    ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE", "OMPI_MCA_orte_hnp_uri"),
)
"""By scheduler: variables with this process, the number of processes, and the coordinator."""
MOST = 100_000


@dataclass(frozen=True)
class Joined:
    """This process among several; srun of SLURM and mpirun of Open MPI set it."""

    coordinator: str | None = None
    """For a training on several hosts: HOST:PORT at which the others reach the first process."""
    processes: Annotated[int, Range(1, MOST)] | None = None
    """For a training on several hosts: how many processes. Without it the scheduler (SLURM, Open
    MPI) decides; 1 is this one alone."""
    process: Annotated[int, Range(0, MOST)] | None = None
    """For a training on several hosts: the number of this process, from 0."""


class Member(NamedTuple):
    """A process among several."""

    number: int
    of: int
    coordinator: str | None
    """None: JAX finds it in the scheduler's environment."""


def member(asked: Joined, environment: Mapping[str, str] | None = None) -> Member:
    """Return this process's number from the options or the environment; (0, 1) if it is alone.

    Raises:
        ValueError: for incomplete options, or numbers out of range.
    """
    given = (asked.coordinator, asked.processes, asked.process)
    if asked.processes == 1 and asked.coordinator is None and not asked.process:
        return Member(0, 1, None)
    if any(value is not None for value in given):
        if None in given:
            raise ValueError(
                "--coordinator, --processes and --process go together: HOST:PORT of the first "
                "process, how many there are, and which one this is"
            )
        coordinator, count, number = given
        host, _, port = str(coordinator).rpartition(":")
        if not (host and port.isascii() and port.isdigit() and int(port[:6]) < 65536):
            raise ValueError(f"--coordinator is {coordinator!r}; allowed is HOST:PORT")
        assert count is not None and number is not None
        if number >= count:
            raise ValueError(f"--process is {number}; allowed is 0 to {count - 1}")
        return Member(number, count, coordinator)
    values = os.environ if environment is None else environment
    for number, count, how in ENVIRONMENTS:
        if {number, count, how} <= set(values) and int(values[count]) > 1:
            return Member(int(values[number]), int(values[count]), None)
    return Member(0, 1, None)


def join(one: Member) -> None:
    """Connect to the other JAX processes; must be called before JAX searches for devices.

    Raises:
        WorkFailed: if the others do not connect in time.
    """
    if one.of == 1:
        return
    import jax

    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    given = one.coordinator is not None
    try:
        jax.distributed.initialize(
            one.coordinator,
            one.of if given else None,
            one.number if given else None,
            cluster_detection_method="deactivate" if given else None,
            initialization_timeout=COME_S,
            heartbeat_timeout_seconds=SILENT_S,
        )
    except RuntimeError as error:
        raise WorkFailed(
            f"process {one.number} of {one.of} did not meet the others at "
            f"{one.coordinator or 'the coordinator that the scheduler names'} within {COME_S} s; "
            "start the same command on every host, with one --coordinator that all of them reach"
        ) from error


def several() -> bool:
    """Return whether this process is one of several."""
    return "jax" in sys.modules and sys.modules["jax"].distributed.is_initialized()


def writes() -> bool:
    """Return whether this process writes the files."""
    return not several() or sys.modules["jax"].process_index() == 0


def agree(what: Mapping[str, Any]) -> None:
    """Check that all processes have the same settings and software.

    Raises:
        ValueError: if they differ.
    """
    if not several():
        return
    import numpy as np
    from jax.experimental import multihost_utils

    from tracks.common.work.pickling import software

    asked = [to_json(what[key]) for key in what] + [to_json(software())]
    sums = [int(hashlib.sha256(text.encode()).hexdigest()[:7], 16) for text in asked]
    found = np.asarray(multihost_utils.process_allgather(np.asarray(sums, np.int32)))
    differs = [name for name, column in zip([*what, "software"], found.T, strict=True)
               if len(set(column.tolist())) > 1]  # fmt: skip
    if differs:
        raise ValueError(
            f"the {len(found)} processes were started apart: they differ in {', '.join(differs)}. "
            "Give all of them the same command and the same version, or --processes 1 to each to "
            "work alone"
        )


def from_the_first(tree: Any) -> Any:
    """Return the first process's arrays in all processes."""
    if not several():
        return tree
    from jax.experimental import multihost_utils

    return multihost_utils.broadcast_one_to_all(tree)


def gathered(trees: list[Any]) -> list[Any]:
    """Return the trees of arrays of all processes in order; each gives the same number."""
    if not several():
        return trees
    import jax
    from jax.experimental import multihost_utils

    found = multihost_utils.process_allgather(trees)
    count = jax.process_count()
    return [
        jax.tree.map(lambda leaf, process=process: leaf[process], tree)
        for process in range(count)
        for tree in found
    ]


def is_gone(error: Exception) -> bool:
    """Return whether an error of JAX means that another process has ended."""
    import jax

    words = str(error)
    return several() and (
        isinstance(error, jax.errors.JaxRuntimeError) or "Gloo" in words or "NCCL" in words
    )

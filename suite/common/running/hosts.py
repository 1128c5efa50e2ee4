"""Run one command in several connected JAX processes, on one host or many.

All processes run the same command. JAX connects them through the first process, the coordinator.
Only that process writes files; the others need no access to its folders.
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

CONNECT_S = 300
"""Time for all processes to connect [s]."""
HEARTBEAT_S = 60
"""A process without a heartbeat for this time counts as ended [s]."""
ENVIRONMENTS = (
    ("SLURM_PROCID", "SLURM_NTASKS", "SLURM_STEP_NODELIST"),
    ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE", "OMPI_MCA_orte_hnp_uri"),
)
"""Environment variables of each scheduler, SLURM and Open MPI: the number of this process, the
number of processes, and the coordinator."""
MOST_PROCESSES = 100_000
"""Largest number of processes."""


@dataclass(frozen=True)
class ProcessOptions:
    """Options that connect this process to others; srun and mpirun make them unnecessary."""

    coordinator: str | None = None
    """For a training on several hosts: HOST:PORT at which the others reach the first process."""
    processes: Annotated[int, Range(1, MOST_PROCESSES)] | None = None
    """For a training on several hosts: the number of processes. Without it the scheduler (SLURM,
    Open MPI) decides; 1 is this process alone."""
    process: Annotated[int, Range(0, MOST_PROCESSES)] | None = None
    """For a training on several hosts: the number of this process, from 0."""


class Member(NamedTuple):
    """The place of this process among several."""

    number: int
    """Number of this process, from 0."""
    processes: int
    coordinator: str | None
    """HOST:PORT of the first process; None: JAX finds it in the scheduler's environment."""


def read_member(options: ProcessOptions, environment: Mapping[str, str] | None = None) -> Member:
    """Return the place of this process, from the options or the environment of a scheduler.

    A process that is alone has the number 0 of 1.

    Raises:
        ValueError: for incomplete options, or numbers out of range.
    """
    values = (options.coordinator, options.processes, options.process)
    if options.processes == 1 and options.coordinator is None and not options.process:
        return Member(0, 1, None)
    if any(value is not None for value in values):
        if None in values:
            raise ValueError(
                "--coordinator, --processes and --process go together: HOST:PORT of the first "
                "process, the number of processes, and the number of this one"
            )
        coordinator, count, number = values
        host, _, port = str(coordinator).rpartition(":")
        if not (host and port.isascii() and port.isdigit() and int(port[:6]) < 65536):
            raise ValueError(f"--coordinator is {coordinator!r}; allowed is HOST:PORT")
        assert count is not None and number is not None
        if number >= count:
            raise ValueError(f"--process is {number}; allowed is 0 to {count - 1}")
        return Member(number, count, coordinator)
    variables = os.environ if environment is None else environment
    for number, count, coordinator in ENVIRONMENTS:
        if {number, count, coordinator} <= set(variables) and int(variables[count]) > 1:
            return Member(int(variables[number]), int(variables[count]), None)
    return Member(0, 1, None)


def connect(member: Member) -> None:
    """Connect to the other JAX processes; must be called before JAX searches for devices.

    Raises:
        WorkFailed: if the others do not connect in time.
    """
    if member.processes == 1:
        return
    import jax

    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    by_options = member.coordinator is not None
    try:
        jax.distributed.initialize(
            member.coordinator,
            member.processes if by_options else None,
            member.number if by_options else None,
            cluster_detection_method="deactivate" if by_options else None,
            initialization_timeout=CONNECT_S,
            heartbeat_timeout_seconds=HEARTBEAT_S,
        )
    except RuntimeError as error:
        coordinator = member.coordinator or "the coordinator that the scheduler names"
        raise WorkFailed(
            f"process {member.number} of {member.processes} did not connect to the others at "
            f"{coordinator} within {CONNECT_S} s; start the same command on every host, with one "
            "--coordinator that all of them reach"
        ) from error


def is_distributed() -> bool:
    """Return whether this process is one of several."""
    return "jax" in sys.modules and sys.modules["jax"].distributed.is_initialized()


def is_writer() -> bool:
    """Return whether this process writes the files, which only the first one does."""
    return not is_distributed() or sys.modules["jax"].process_index() == 0


def check_same(settings: Mapping[str, Any]) -> None:
    """Check that all processes have the same `settings` (by name) and the same software.

    Raises:
        ValueError: with the names of the settings that differ.
    """
    if not is_distributed():
        return
    import numpy as np
    from jax.experimental import multihost_utils

    from tracks.common.work.pickling import software

    # Each process sends a checksum of every setting: 28 bits, which fit into an int32.
    texts = [*map(to_json, settings.values()), to_json(software())]
    checksums = [int(hashlib.sha256(text.encode()).hexdigest()[:7], 16) for text in texts]
    gathered = np.asarray(multihost_utils.process_allgather(np.asarray(checksums, np.int32)))
    differing = [name for name, column in zip([*settings, "software"], gathered.T, strict=True)
                 if len(set(column.tolist())) > 1]  # fmt: skip
    if differing:
        raise ValueError(
            f"the {len(gathered)} processes differ in {', '.join(differing)}. Give all of them the "
            "same command and the same version, or --processes 1 to each for separate runs"
        )


def broadcast_from_first(tree: Any) -> Any:
    """Return the tree of arrays of the first process, in all processes."""
    if not is_distributed():
        return tree
    from jax.experimental import multihost_utils

    return multihost_utils.broadcast_one_to_all(tree)


def gather(trees: list[Any]) -> list[Any]:
    """Return the trees of arrays of all processes, in the order of the processes.

    Every process must pass the same number of trees.
    """
    if not is_distributed():
        return trees
    import jax
    from jax.experimental import multihost_utils

    stacked = multihost_utils.process_allgather(trees)
    count = jax.process_count()
    return [
        jax.tree.map(lambda leaf, process=process: leaf[process], tree)
        for process in range(count)
        for tree in stacked
    ]


def is_process_lost(error: Exception) -> bool:
    """Return whether an error of JAX means that another process has ended."""
    import jax

    text = str(error)
    return is_distributed() and (
        isinstance(error, jax.errors.JaxRuntimeError) or "Gloo" in text or "NCCL" in text
    )

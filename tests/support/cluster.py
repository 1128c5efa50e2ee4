"""A real cluster on this machine: a scheduler and nodes, processes of their own, ended again."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time

import pytest

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
START_S = 120.0


class Cluster:
    """Its address, and its nodes, which can be killed."""

    def __init__(self, address, nodes):
        self.address, self.nodes = address, nodes

    def kill(self, number):
        """Kill a node with all of its processes, as a machine dies."""
        _end(self.nodes[number])


def free_port():
    """Return a port of this machine that is free."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@contextlib.contextmanager
def cluster(folder, nodes=2, memory="3GB", tls=(), **environment):
    """Be a cluster of `nodes` machines with a worker each; skip where the extra is missing.

    `tls` are the options of its scheduler and workers that make it one of encrypted messages.
    """
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    port = free_port()
    address = f"{'tls' if tls else 'tcp'}://127.0.0.1:{port}"
    started = []
    try:
        place = ["--host", address.rpartition(":")[0], "--port", str(port), *tls]
        started.append(_start(["scheduler", *place, "--no-dashboard"], folder, environment))
        for _ in range(nodes):
            limits = ["--nworkers", "1", "--nthreads", "1", "--memory-limit", memory, *tls]
            where = ["--local-directory", str(folder), "--no-dashboard"]
            started.append(_start(["worker", address, *limits, *where], folder, environment))
        _wait(address, nodes)
        yield Cluster(address, started[1:])
    finally:
        for process in reversed(started):
            _end(process)


def _start(args, folder, environment):
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    log = open(os.path.join(folder, f"{args[0]}.log"), "ab")
    code = f"from distributed.cli.dask_{args[0]} import main; main()"
    with log:
        return subprocess.Popen(
            [sys.executable, "-c", code, *args[1:]], stdout=log, stderr=log,
            stdin=subprocess.DEVNULL, start_new_session=True, cwd=folder,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), **environment},
        )  # fmt: skip


def _end(process):
    """Kill a process and all that it started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _wait(address, nodes):
    from tracks.common.work.cluster import UnusableCluster, size

    until = time.monotonic() + START_S
    while True:
        with contextlib.suppress(UnusableCluster):
            if size(address) == nodes:
                return
        assert time.monotonic() < until, "the cluster did not come up; see its logs"
        time.sleep(0.5)

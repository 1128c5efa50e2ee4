"""Pieces of work in processes and on a cluster: results by number, what goes wrong, what dies."""

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import MappingProxyType, SimpleNamespace

import pytest

from suite.common.errors import explain
from tests.support.cluster import cluster
from tests.support.tools import python
from tracks.common.work import WorkerDied, core_shares, run_pieces, worker_count
from tracks.common.work.cluster import UnusableCluster
from tracks.common.work.pickling import software


@pytest.fixture(scope="module")
def node(tmp_path_factory):
    """The address of a cluster with one node, which starts in half the time of two."""
    with cluster(tmp_path_factory.mktemp("cluster"), nodes=1) as found:
        yield found.address


@pytest.fixture(scope="module", params=["processes", "cluster"])
def two(request):
    """Two processes of this machine, or the node of a cluster."""
    return 2 if request.param == "processes" else request.getfixturevalue("node")


def tens(table, piece):
    time.sleep(0.05)  # else one worker may do them all before the other has begun
    for item in piece:
        yield item, table[0] * item, os.getpid()


def load(name):
    from policies.policy import load_policy

    yield load_policy(name)


def gone_wrong(how, piece):
    yield "before"
    if how == "refuse":
        raise ValueError("wrong policy file")
    if how == "break":
        raise ZeroDivisionError
    os.kill(os.getpid(), signal.SIGKILL)


def dies_once(folder, piece):
    """End the process at the second result of piece 1, the first time that it is begun."""
    time.sleep(0.3)
    yield piece, 0
    mark = Path(folder, str(piece))
    if piece == 1 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    yield piece, 1


def lived(folder, piece):
    """Note each begin; take a while."""
    with open(os.path.join(folder, f"{piece}.begun"), "a") as file:
        file.write(f"{os.getpid()}\n")
    time.sleep(0.1)
    yield piece * piece


def slow(piece):
    for number in range(1000):
        yield number
        time.sleep(0.3)


def check_numbers(workers):
    pieces = [[k, k + 1] for k in range(20)] + [[]]
    work = partial(tens, MappingProxyType({0: 10}))
    wanted = [(n, item, 10 * item) for n, piece in enumerate(pieces) for item in piece]
    found = []
    run_pieces(work, iter(pieces), workers, lambda *entry: found.append(entry))
    assert sorted((n, item, ten) for n, (item, ten, _) in found) == wanted
    others = {pid for _, (_, _, pid) in found} - {os.getpid()}
    assert len(others) == worker_count(workers) - (workers == 1)
    assert multiprocessing.active_children() == []


def test_every_result_comes_with_the_number_of_its_piece(two):
    check_numbers(two)


def test_in_this_process_every_result_comes_with_the_number_of_its_piece():
    check_numbers(1)


@pytest.mark.parametrize(
    ("how", "error", "text"),
    [("refuse", ValueError, "^wrong policy file$"), ("break", ZeroDivisionError, None)],
)
def test_what_goes_wrong_there_is_said_here(two, how, error, text):
    with pytest.raises(error, match=text) as caught:
        run_pieces(partial(gone_wrong, how), [1, 2, 3], two, lambda *_: None)
    assert "in gone_wrong" in str(caught.value.__cause__)
    assert explain(caught.value) is None, "a test's own error is not the suite's"
    assert multiprocessing.active_children() == []


def test_a_refusal_there_is_a_message_to_the_user(two):
    with pytest.raises(ValueError) as caught:
        run_pieces(load, ["no-such-policy"], two, lambda *_: None)
    code, message = explain(caught.value) or (0, "")
    assert code == 2 and "no-such-policy" in message


def test_an_interrupt_ends_it_at_once_and_keeps_what_came(two):
    found, started = [], time.monotonic()

    def keep(number, result):
        found.append(result)
        raise KeyboardInterrupt

    work = slow if two == 2 else partial(tens, {0: 1})
    with pytest.raises(KeyboardInterrupt):
        run_pieces(work, [[k] for k in range(200)], two, keep)
    assert len(found) == 1 and multiprocessing.active_children() == []
    assert time.monotonic() - started < 100, "in processes the pieces take 30,000 s"


@pytest.mark.extended
def test_a_piece_whose_process_died_is_done_again_and_once_only(tmp_path):
    found = []
    pieces = range(4)
    run_pieces(partial(dies_once, str(tmp_path)), pieces, 2, lambda *entry: found.append(entry))
    assert set(found) == {(n, (n, k)) for n in pieces for k in (0, 1)}
    assert found.count((1, (1, 0))) == 2 and len(found) == 9
    with pytest.raises(WorkerDied, match="exit code -9.*fewer processes"):
        run_pieces(partial(gone_wrong, "kill"), [1, 2, 3], 2, lambda *_: None)
    assert multiprocessing.active_children() == []


def test_no_core_is_in_two_shares(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3, 5, 6, 7, 9})
    assert core_shares(2) == [[3, 5], [6, 7]]
    assert core_shares(1) == [[3, 5, 6, 7, 9]]


def test_processes_end_with_the_one_they_work_for(tmp_path, root):
    code = (
        "import os, signal\n"
        "from tests.tracks.common.work.test_pieces import slow\n"
        "from tracks.common.work import run_pieces\n"
        "def keep(number, result):\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
        "if __name__ == '__main__':\n"
        "    run_pieces(slow, [1, 2], 2, keep)\n"
    )
    program = tmp_path / "program.py"
    program.write_text(code)
    # The pipe closes when the last process that holds it has ended: before the 300 s of a piece.
    done = subprocess.run(
        [sys.executable, program], capture_output=True, timeout=60,
        env={**os.environ, "PYTHONPATH": str(root)},
    )  # fmt: skip
    assert done.returncode == -signal.SIGKILL


def test_a_machine_that_would_come_to_other_numbers_is_refused(node, monkeypatch):
    wanted = {**software(), "mujoco": "2.0"}
    monkeypatch.setattr("tracks.common.work.cluster.software", lambda: wanted)
    with pytest.raises(UnusableCluster, match=r"mujoco 3\S+ there, 2\.0 here.*same versions"):
        run_pieces(load, ["race"], node, lambda *_: None)


class Future:
    """A piece that has ended: piece 1 was given up, the others have a result."""

    def __init__(self, number, value):
        self.status, self.value = "error" if number == 1 else "finished", value

    def exception(self):
        return KeyError("lost")

    def add_done_callback(self, call):
        call(self)


CLIENT = SimpleNamespace(
    nthreads=lambda: {"node": 1},
    submit=lambda function, packed, key: packed,
    replicate=lambda futures: None,
    map=lambda function, pieces, work, key: [
        Future(n, function(piece, work)) for n, piece in enumerate(pieces)
    ],
    gather=lambda futures, errors: [future.value for future in futures],
)


def test_finished_pieces_are_kept_before_the_error_of_another_one(monkeypatch):
    monkeypatch.setattr("tracks.common.work.cluster._connected", lambda _: nullcontext(CLIENT))
    found = []
    with pytest.raises(WorkerDied, match="gave up piece 1"):
        run_pieces(partial(tens, {0: 1}), [[5], [6], [7]], "tcp://a:1", lambda *k: found.append(k))
    assert [(number, item) for number, (item, _, _) in found] == [(0, 5), (2, 7)]


NO_SCHEDULER = """
import os, socket, threading, time
from tracks.common.work import cluster, worker_count
import distributed
def garbage(c):
    c.sendall(b"HTTP/1.1 400 Bad" * 99)
    time.sleep(100)
def serve(port, behave):
    while True:
        threading.Thread(target=behave, args=(port.accept()[0],), daemon=True).start()
addresses, late = [9], False
for behave in (lambda c: time.sleep(100), garbage, lambda c: c.close()):
    port = socket.create_server(("127.0.0.1", 0))
    threading.Thread(target=serve, args=(port, behave), daemon=True).start()
    addresses.append(port.getsockname()[1])
cluster.ANSWER_S = 1.0
for port in addresses:
    began = time.monotonic()
    try:
        worker_count(f"tcp://127.0.0.1:{port}")
    except cluster.UnusableCluster as error:
        print(error, flush=True)
    late |= time.monotonic() - began > 10.0
os._exit(late)
"""
"""Asks at a port of nobody, at one of who is silent, of a web server and of who hangs up."""


@pytest.mark.extended
def test_a_port_of_something_else_is_refused_in_the_time_that_is_promised():
    """In a process of its own, as Dask's client tries on beside when we gave it up."""
    pytest.importorskip("distributed")
    done = python(NO_SCHEDULER)
    assert done.returncode == 0 and not done.stderr, done.stderr
    said = done.stdout.splitlines()
    assert len(said) == 4 and said[0].startswith("--workers tcp://127.0.0.1:9: ")
    assert all("no scheduler of a Dask cluster answers there; " in line for line in said)
    assert all("dask scheduler" in line for line in said)


@pytest.mark.slow
def test_messages_are_encrypted_where_the_address_says_so(tmp_path, monkeypatch):
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl, which makes the certificates")
    key, cert = tmp_path / "key.pem", tmp_path / "cert.pem"
    made = ["-newkey", "rsa:2048", "-nodes", "-keyout", str(key), "-out", str(cert)]
    subject = ["-subj", "/CN=127.0.0.1", "-days", "2"]
    subprocess.run(["openssl", "req", "-x509", *made, *subject], check=True, capture_output=True)
    tls = ("--tls-ca-file", str(cert), "--tls-cert", str(cert), "--tls-key", str(key))
    import dask

    where = {"ca-file": cert, "client.cert": cert, "client.key": key}
    options = {f"distributed.comm.tls.{name}": str(path) for name, path in where.items()}
    with pytest.raises(UnusableCluster, match="DASK_DISTRIBUTED__COMM__TLS__CA_FILE"):
        worker_count("tls://127.0.0.1:9")
    with dask.config.set(options), cluster(tmp_path, nodes=1, tls=tls) as found:
        results = []
        run_pieces(partial(tens, {0: 10}), [[1, 2]], found.address, lambda n, r: results.append(r))
        assert [ten for _, ten, _ in results] == [10, 20] and found.address.startswith("tls://")
        with dask.config.set({"distributed.comm.tls.ca-file": None}):
            with pytest.raises(UnusableCluster):
                worker_count(found.address)


@pytest.mark.extended
def test_a_node_that_dies_costs_its_pieces_once_and_a_piece_that_kills_ends_the_work(tmp_path):
    with cluster(tmp_path) as found:
        check_numbers(found.address)
        check_deaths(found, tmp_path)


def check_deaths(found, tmp_path):
    results = {}

    def keep(number, result):
        results[number] = result
        if len(results) == 10:
            threading.Thread(target=found.kill, args=[0]).start()

    run_pieces(partial(lived, str(tmp_path)), range(30), found.address, keep)
    assert results == {k: k * k for k in range(30)}
    begun = [len((tmp_path / f"{k}.begun").read_text().split()) for k in range(30)]
    # What it was at, and what it had done and not handed over yet.
    assert sum(begun) - 30 <= 3 and max(begun) <= 2 and worker_count(found.address) == 1
    with pytest.raises(WorkerDied, match="gave up piece 0.*same command continues"):
        run_pieces(partial(gone_wrong, "kill"), [1], found.address, lambda *_: None)

"""Pieces of work in processes: results as they come, what goes wrong as it is, nobody left."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from tracks.common.work import WorkerDied, core_shares, run_pieces

CORES = sorted(os.sched_getaffinity(0))


def tens(piece):
    for item in piece:
        yield item, 10 * item, os.getpid()


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


def where(piece):
    yield piece, tuple(sorted(os.sched_getaffinity(0)))


def slow(piece):
    for number in range(1000):
        yield number
        time.sleep(0.3)


@pytest.mark.parametrize("workers", [1, 2])
def test_every_result_comes_with_the_number_of_its_piece(workers):
    found, pieces = [], [[0, 1, 2], [], [3], [4, 5]]
    run_pieces(tens, pieces, workers, lambda number, result: found.append((number, result)))
    assert sorted((n, item, ten) for n, (item, ten, _) in found) == [
        (0, 0, 0), (0, 1, 10), (0, 2, 20), (2, 3, 30), (3, 4, 40), (3, 5, 50),
    ]  # fmt: skip
    here = {pid == os.getpid() for _, (_, _, pid) in found}
    assert here == {workers == 1}
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize(
    ("how", "error", "text"),
    [
        ("refuse", ValueError, "^wrong policy file$"),
        ("break", ZeroDivisionError, None),
        ("killed", WorkerDied, "exit code -9.*fewer processes"),
    ],
)
def test_what_goes_wrong_there_is_said_here(how, error, text):
    with pytest.raises(error, match=text):
        run_pieces(partial(gone_wrong, how), [1, 2, 3], 2, lambda *_: None)
    assert multiprocessing.active_children() == []


def test_a_piece_whose_process_died_is_done_again(tmp_path):
    found = []
    pieces = range(4)
    run_pieces(partial(dies_once, str(tmp_path)), pieces, 2, lambda *entry: found.append(entry))
    assert set(found) == {(n, (n, k)) for n in pieces for k in (0, 1)}
    assert found.count((1, (1, 0))) == 2 and len(found) == 9
    assert multiprocessing.active_children() == []


def test_an_interrupt_ends_all_at_once_and_keeps_what_came():
    found = []

    def keep(number, result):
        found.append(result)
        raise KeyboardInterrupt

    started = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_pieces(slow, [1, 2], 2, keep)
    assert found == [0] and multiprocessing.active_children() == []
    assert time.monotonic() - started < 100, "the pieces take 300 s"


def test_no_core_is_in_two_shares(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {3, 5, 6, 7, 9})
    assert core_shares(2) == [[3, 5], [6, 7]]
    assert core_shares(1) == [[3, 5, 6, 7, 9]]


@pytest.mark.skipif(len(CORES) < 2, reason="needs two cores")
def test_pinned_processes_share_no_core():
    found = {}
    run_pieces(where, range(6), 2, lambda _, result: found.update([result]), pinned=True)
    assert set(found.values()) <= set(map(tuple, core_shares(2)))


def test_processes_end_with_the_one_they_work_for(tmp_path, root):
    code = (
        "import os, signal\n"
        "from tests.tracks.common.work.test_processes import slow\n"
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

"""Pieces of work in processes: in order, pinned apart, and what is said when one dies."""

import os

import pytest

from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.common.work import Silent, all_done, check_jobs
from tracks.common.work import core_shares

CORES = sorted(os.sched_getaffinity(0))


def double(piece, console):
    assert type(console) is Silent
    return 2 * piece, sorted(os.sched_getaffinity(0))


def die(piece, console):
    os._exit(7)


def diverge(piece, console):
    raise WorkFailed(f"training {piece} diverged")


def test_more_processes_than_cores_are_refused(monkeypatch):
    monkeypatch.setattr("suite.common.work.usable_cores", lambda: 2)
    check_jobs(2)
    for jobs in (0, 3):
        with pytest.raises(ValueError, match=f"--jobs is {jobs}; allowed is 1 to 2"):
            check_jobs(jobs)


@pytest.mark.skipif(len(CORES) < 2, reason="needs two cores")
def test_pieces_come_back_in_order_from_processes_that_share_no_core():
    found = all_done(double, [5, 6, 7], 2, Console(), "doubling")
    assert [value for value, _ in found] == [10, 12, 14]
    assert {tuple(cores) for _, cores in found} <= set(map(tuple, core_shares(2)))


@pytest.mark.skipif(len(CORES) < 2, reason="needs two cores")
def test_a_process_that_dies_is_said():
    with pytest.raises(WorkFailed, match=r"dying: a process ended badly.*exit code 7"):
        all_done(die, [1, 2], 2, Console(), "dying")


@pytest.mark.skipif(len(CORES) < 2, reason="needs two cores")
def test_work_that_fails_says_so_in_its_own_words():
    with pytest.raises(WorkFailed, match=r"^training 1 diverged$"):
        all_done(diverge, [1], 2, Console(), "training")

"""Long pieces of work in processes: in order, pinned apart, and what is said when one dies."""

import os
from pathlib import Path

import pytest

from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.common.running.remote import Job
from suite.common.work import Silent, do_jobs, read_workers_option
from tracks.common.work import core_shares

CORES = sorted(os.sched_getaffinity(0))


def jobs(*tasks):
    return [Job(task, Path("nowhere")) for task in tasks]


def double(job, console):
    assert type(console) is Silent
    return 2 * job.task, sorted(os.sched_getaffinity(0))


def die(job, console):
    os._exit(7)


def diverge(job, console):
    raise WorkFailed(f"training {job.task} diverged")


def test_more_processes_than_cores_are_refused_where_each_needs_some(monkeypatch):
    monkeypatch.setattr("suite.common.work.usable_cores", lambda: 2)
    assert read_workers_option("3") == 3 and read_workers_option("2", whole_cores=True) == 2
    assert read_workers_option("a:1", whole_cores=True) == "tcp://a:1"
    with pytest.raises(ValueError, match="--workers is 3; allowed is 1 to 2"):
        read_workers_option("3", whole_cores=True)


@pytest.mark.skipif(len(CORES) < 2, reason="needs two cores")
def test_jobs_come_back_in_order_from_processes_that_share_no_core_or_say_what_failed():
    found = do_jobs(double, jobs(5, 6, 7), 2, Console(), "doubling")
    assert [value for value, _ in found] == [10, 12, 14]
    assert {tuple(cores) for _, cores in found} <= set(map(tuple, core_shares(2)))
    with pytest.raises(WorkFailed, match=r"dying: a process died; the products.*exit code 7"):
        do_jobs(die, jobs(1, 2), 2, Console(), "dying")
    with pytest.raises(WorkFailed, match=r"^training 1 diverged$"):
        do_jobs(diverge, jobs(1), 2, Console(), "training")

"""Long pieces of work in processes: in order, pinned apart, and what is said when one dies."""

import os
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.common.running.remote import Job
from suite.common.work import Forwarding, do_jobs, read_workers_option
from tracks.common.work import core_shares

CORES = sorted(os.sched_getaffinity(0))


def jobs(*tasks):
    return [Job(task, Path("nowhere")) for task in tasks]


class Recorded(Console):
    """A console that keeps what it would show."""

    def __init__(self):
        self.shown = []

    @contextmanager
    def progress(self, label, total, clock=None, begun=0.0):
        yield lambda done, note="": self.shown.append((done, total))


def double(job, console):
    assert type(console) is Forwarding
    with console.progress("halves", 10) as update:
        update(5)
        # A process returns messages five times a second.
        time.sleep(0.3)
        update(9)
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
    console = Recorded()
    found = do_jobs(double, jobs(5, 6, 7), 2, console, "doubling")
    assert [value for value, _ in found] == [10, 12, 14]
    assert {tuple(cores) for _, cores in found} <= set(map(tuple, core_shares(2)))
    amounts = [done for done, total in console.shown if total == 3]
    assert amounts == sorted(amounts) and amounts[0] == 0.5 and amounts[-1] == 3
    with pytest.raises(WorkFailed, match=r"dying: a process died; the products.*exit code 7"):
        do_jobs(die, jobs(1, 2), 2, Console(), "dying")
    with pytest.raises(WorkFailed, match=r"^training 1 diverged$"):
        do_jobs(diverge, jobs(1), 2, Console(), "training")

"""Several processes of one training: found by options or a scheduler, as one, and one that dies."""

import json
import os
import signal
import socket
import subprocess
import sys
import time

import numpy as np
import pytest

from policies.formats.checkpoint import load_arrays
from suite.common.running.hosts import (
    Member,
    ProcessOptions,
    is_distributed,
    is_writer,
    read_member,
)

SLURM = {"SLURM_PROCID": "2", "SLURM_NTASKS": "4", "SLURM_STEP_NODELIST": "node[001-004]"}
OPEN_MPI = {
    "OMPI_COMM_WORLD_RANK": "1", "OMPI_COMM_WORLD_SIZE": "2",
    "OMPI_MCA_orte_hnp_uri": "1314521088.0;tcp://10.0.0.1:43370",
}  # fmt: skip


def test_a_process_finds_its_place_and_alone_it_writes():
    for asked, environment, found in (
        (ProcessOptions(), {}, Member(0, 1, None)),
        (ProcessOptions("head:7777", 3, 2), {}, Member(2, 3, "head:7777")),
        (ProcessOptions(), SLURM, Member(2, 4, None)),
        (ProcessOptions(), OPEN_MPI, Member(1, 2, None)),
        (ProcessOptions(), {**SLURM, "SLURM_NTASKS": "1", "SLURM_PROCID": "0"}, Member(0, 1, None)),
        (ProcessOptions(processes=1), SLURM, Member(0, 1, None)),
    ):
        assert read_member(asked, environment) == found
    assert is_writer() and not is_distributed()


def test_options_that_do_not_go_together_are_refused():
    for asked, words in (
        (ProcessOptions(processes=2), "go together"),
        (ProcessOptions("head:7777", 2, 2), "--process is 2; allowed is 0 to 1"),
        (ProcessOptions("head", 2, 0), "--coordinator is 'head'; allowed is HOST:PORT"),
        (ProcessOptions("head:99999", 2, 0), "allowed is HOST:PORT"),
    ):
        with pytest.raises(ValueError, match=words):
            read_member(asked, {})


MEETING = """
import os, sys
import numpy as np
from suite.common.running.hosts import broadcast_from_first, check_same, connect, read_member
from suite.common.running.hosts import ProcessOptions, is_distributed, is_process_lost, is_writer
connect(read_member(ProcessOptions(sys.argv[1], 2, int(sys.argv[2]))))
number = int(sys.argv[2])
assert is_distributed() and is_writer() == (number == 0)
assert broadcast_from_first({"a": np.arange(3) + number})["a"].tolist() == [0, 1, 2]
check_same({"the seed": 7})
try:
    check_same({"the size": 1, "the seed": number})
except ValueError as error:
    print(error, flush=True)
if number == 0:
    os._exit(9)
try:
    broadcast_from_first(np.ones(2))
except Exception as error:
    print("gone" if is_process_lost(error) else repr(error), flush=True)
os._exit(0)
"""


def address():
    """Return an address of this machine that is free."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{free.getsockname()[1]}"


def ends(processes, seconds=300):
    """Return the exit codes of processes and what they said; end all."""
    try:
        said = [
            "".join(filter(None, process.communicate(timeout=seconds))) for process in processes
        ]
        return [process.returncode for process in processes], said
    finally:
        for process in processes:
            process.kill()


def test_two_processes_meet_agree_and_hear_that_one_is_gone(tmp_path, root):
    where = address()
    environment = {**os.environ, "PYTHONPATH": str(root), "JAX_PLATFORMS": "cpu"}
    both = [
        subprocess.Popen(
            [sys.executable, "-c", MEETING, where, str(k)], cwd=tmp_path, env=environment,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )
        for k in (0, 1)
    ]  # fmt: skip
    codes, said = ends(both, 120)
    assert codes == [9, 0], said
    assert all("processes differ in the seed. Give" in words for words in said), said
    assert said[1].strip().endswith("gone")


class Trainings:
    """The same training, by one process of two devices or by two of one each."""

    def __init__(self, folder, root):
        self.folder, self.root = folder, root

    def start(self, out, *options, devices=1):
        code = (
            "import sys, suite.train.training_loop as training_loop\n"
            "from suite.cli import entry\n"
            "training_loop.SAVE_PERIOD_S = 0.2\n"
            "entry()\n"
        )
        args = ["train", "--recipe", "quick", "--iterations", "120"]
        args += ["--set", "episode.batch=4", "episode.steps=4", "--out", str(self.folder / out)]
        environment = {
            **os.environ, "PYTHONPATH": str(self.root), "JAX_PLATFORMS": "cpu", "NPROC": "2",
            "XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}",
            "JAX_COMPILATION_CACHE_DIR": str(self.folder / "compiled"),
        }  # fmt: skip
        return subprocess.Popen(
            [sys.executable, "-c", code, *args, *options], cwd=self.folder, env=environment,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def both(self, out):
        where = ("--coordinator", address(), "--processes", "2", "--process")
        return [self.start(out, *where, str(k)) for k in (0, 1)]

    def result(self, out):
        lines = (self.folder / out / "metrics.jsonl").read_text().splitlines()
        clock = ("seconds", "cold", "steps_per_s")
        rows = [{k: v for k, v in json.loads(x).items() if k not in clock} for x in lines]
        return rows, load_arrays(self.folder / out / "policy", kind="policy").arrays


def rows_there(path):
    return len(path.read_text().splitlines()) if path.is_file() else 0


@pytest.fixture(scope="module")
def trainings(tmp_path_factory, root):
    found = Trainings(tmp_path_factory.mktemp("hosts"), root)
    codes, said = ends([found.start("one", devices=2)])
    assert codes == [0], said
    return found


@pytest.mark.slow
@pytest.mark.parametrize("killed", [0, 1])
def test_two_processes_train_as_one_and_go_on_after_a_kill_of_either(trainings, killed):
    out = f"two-{killed}"
    processes = trainings.both(out)
    try:
        curve = trainings.folder / out / "metrics.jsonl"
        until = time.monotonic() + 300
        while rows_there(curve) < 20 and time.monotonic() < until:
            time.sleep(0.1)
        processes[killed].send_signal(signal.SIGKILL)
    finally:
        codes, said = ends(processes)
    assert codes[killed] == -signal.SIGKILL and codes[1 - killed] == 1, said
    assert "another process of this training is gone" in said[1 - killed]
    assert "same command on every host" in said[1 - killed] and "Traceback" not in said[1 - killed]
    assert 20 <= rows_there(curve) < 120, "it was cut off on the way"
    codes, said = ends(trainings.both(out))
    assert codes == [0, 0], said
    (rows, arrays), (expected, weights) = trainings.result(out), trainings.result("one")
    assert rows == expected, "the curve of one process with the same devices, to the bit"
    assert all(np.array_equal(arrays[name], weights[name]) for name in weights)

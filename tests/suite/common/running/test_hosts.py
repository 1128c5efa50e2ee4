"""Trainings in several processes and commands on a cluster: the same files, also after a kill."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import eval.judging.judge
import eval.judging.results
from policies import shipped
from policies.formats.checkpoint import load_arrays
from suite import cli
from suite.common.running.hosts import (
    Member,
    ProcessOptions,
    is_distributed,
    is_writer,
    read_member,
)
from tests.support.cluster import cluster, free_port
from tests.support.commands import refused
from tests.support.tools import program

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


@pytest.mark.extended
def test_two_processes_meet_agree_and_hear_that_one_is_gone(tmp_path, root):
    where = f"127.0.0.1:{free_port()}"
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
        where = ("--coordinator", f"127.0.0.1:{free_port()}", "--processes", "2", "--process")
        return [self.start(out, *where, str(k)) for k in (0, 1)]

    def result(self, out):
        lines = (self.folder / out / "metrics.jsonl").read_text().splitlines()
        clock = ("seconds", "cold", "steps_per_s")
        rows = [{k: v for k, v in json.loads(x).items() if k not in clock} for x in lines]
        return rows, load_arrays(self.folder / out / "policy", kind="policy").arrays


def lines(path):
    return path.read_text().splitlines() if path.is_file() else []


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
        while len(lines(curve)) < 20 and time.monotonic() < until:
            time.sleep(0.1)
        processes[killed].send_signal(signal.SIGKILL)
    finally:
        codes, said = ends(processes)
    assert codes[killed] == -signal.SIGKILL, said
    if killed == 0 and codes[1] == -signal.SIGABRT:
        # JAX may notice first that its coordinator is gone, and ends the process itself.
        assert "another task died" in said[1]
    else:
        assert codes[1 - killed] == 1, said
        assert "another process of this training is gone" in said[1 - killed]
        assert "Repeat the command on every host" in said[1 - killed]
        assert "Traceback" not in said[1 - killed]
    assert 20 <= len(lines(curve)) < 120, "it was cut off on the way"
    codes, said = ends(trainings.both(out))
    assert codes == [0, 0], said
    (rows, arrays), (expected, weights) = trainings.result(out), trainings.result("one")
    assert rows == expected, "the curve of one process with the same devices, to the bit"
    assert all(np.array_equal(arrays[name], weights[name]) for name in weights)


TRIALS = ["--track", "zigzag", "--difficulty", "0,9", "--trials", "12"]
FILES = ("table.md", "trials.parquet")


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """The policy by path, and its table as one process makes it."""
    folder = tmp_path_factory.mktemp("flown")
    shutil.copytree(shipped.locate("race-paper"), folder / "mine")
    args = ["eval", "--policy", str(folder / "mine"), *TRIALS]
    assert cli.main([*args, "--workers", "1", "--out", str(folder / "one")]) == 0
    return args, folder / "one"


def same_table(there, here):
    return all((there / name).read_bytes() == (here / name).read_bytes() for name in FILES)


def kill_a_node(journal, nodes):
    """Kill one after a third of the trials."""
    until = time.monotonic() + 200.0
    while len(lines(journal)) <= 8 and time.monotonic() < until:
        time.sleep(0.05)
    nodes.kill(0)


@pytest.mark.slow
def test_a_node_killed_after_a_third_leaves_the_table_as_it_is(flown, tmp_path, monkeypatch):
    args, one = flown
    monkeypatch.setattr(eval.judging.judge, "MOST_A_PIECE", 2)
    out = tmp_path / "out"
    with cluster(tmp_path) as nodes:
        journal = out / "journal-0.jsonl"
        beside = threading.Thread(target=kill_a_node, args=(journal, nodes))
        beside.start()
        assert cli.main([*args, "--workers", nodes.address, "--out", str(out)]) == 0
        beside.join()
    assert same_table(out, one)


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        "collect --policy race-paper --track zigzag --difficulty 0 --trials 6",
        "reproduce robustness --policy race-paper --policy race --trials 2 --only wind",
        "loop --recipe quick --iterations 4 --finetune-iterations 2 --fit-iterations 4 --trials 2 "
        "--flights 2 --track zigzag --difficulty 0 --set episode.batch=4 episode.steps=20",
        "blind make --simulator continuous --seed 5 --count 2",
    ],
    ids=lambda command: command.split()[0],
)
def test_a_command_comes_to_the_same_on_a_cluster(command, tmp_path, root, monkeypatch):
    monkeypatch.syspath_prepend(root / "tools")
    digest = program(root / "tools" / "kills.py").digest
    here, there = tmp_path / "here", tmp_path / "there"
    again = ["blind run"] if command.startswith("blind") else []
    with cluster(tmp_path, XDG_CACHE_HOME=str(tmp_path / "cache")) as nodes:
        for words in (command, *again):
            for out, workers in ((here, "1"), (there, nodes.address)):
                cache = ["--cache", str(out / "cache")] if command.startswith("reproduce") else []
                args = [*words.split(), *cache, "--out", str(out), "--workers", workers]
                assert cli.main(args) == 0
    assert digest(here) == digest(there)
    # A document has none of the files that a digest is of.
    pages = [path.name for path in here.glob("robustness*")]
    assert all((here / page).read_bytes() == (there / page).read_bytes() for page in pages)
    assert pages or digest(here) != "nothing"


def test_a_missing_extra_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "distributed", None)
    args = (*TRIALS, "--workers", "head:8786", "--out", tmp_path / "out")
    assert "pip install 'diffracing-suite[cluster]'" in refused(capsys, "eval", *args)
    assert not (tmp_path / "out").exists()

"""Commands on a cluster of two nodes: the same files, also where a node is killed."""

import shutil
import sys
import threading
import time

import pytest

import eval.judging.judge
import eval.judging.results
from policies import shipped
from suite import cli
from tests.support.cluster import cluster
from tests.support.commands import refused
from tests.support.tools import program

TRIALS = ["--track", "zigzag", "--difficulty", "0,9", "--trials", "12"]
FILES = ("table.md", "trials.parquet")


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """The policy by path, and its table as one process makes it."""
    folder = tmp_path_factory.mktemp("flown")
    shutil.copytree(shipped.folder("race-paper"), folder / "mine")
    args = ["eval", "--policy", str(folder / "mine"), *TRIALS]
    assert cli.main([*args, "--workers", "1", "--out", str(folder / "one")]) == 0
    return args, folder / "one"


def same_table(there, here):
    return all((there / name).read_bytes() == (here / name).read_bytes() for name in FILES)


def lines(path):
    return path.read_text().splitlines() if path.is_file() else []


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

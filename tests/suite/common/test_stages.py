"""Stages in folders: done once, found again, refused for another configuration."""

import json
from dataclasses import dataclass

import pytest

from suite.common.console import Console
from suite.common.stages import MARK, Estimate, Stage, announce, claim, do_stages


@dataclass(frozen=True)
class Settings:
    trials: int = 3
    track: str = "zigzag"


def stages(done, broken=False):
    def work(name):
        def do(folder):
            if broken and name == "second":
                raise RuntimeError("cut off")
            folder.mkdir(parents=True, exist_ok=True)
            done.append(name)

        return do

    return [
        Stage(name, f"doing the {name}", Estimate(1.0, 1.0), work(name), lambda f: done.append(f))
        for name in ("first", "second")
    ]


def test_a_stage_is_done_once_and_told_again(tmp_path, capfd):
    done = []
    with pytest.raises(RuntimeError):
        do_stages(tmp_path, stages(done, broken=True), Console(), "the run")
    assert done == ["first", tmp_path / "first"] and not (tmp_path / "second" / MARK).exists()
    assert "the run: about 2.0 s" in capfd.readouterr().err
    done.clear()
    took = do_stages(tmp_path, stages(done), Console(), "the run")
    assert done == [tmp_path / "first", "second", tmp_path / "second"]
    assert list(took) == ["first", "second"]
    assert took["first"] == json.loads((tmp_path / "first" / MARK).read_text())["seconds"]
    said = capfd.readouterr().err
    assert "[1/2] doing the first: done before" in said and "[2/2] took" in said
    assert "the run: about 1.0 s" in said
    do_stages(tmp_path, stages([]), Console(), "the run")
    assert "about" not in capfd.readouterr().err


def test_a_folder_of_another_configuration_is_refused(tmp_path):
    claim(tmp_path, Settings(), 0)
    claim(tmp_path, Settings(), 0)
    with pytest.raises(ValueError, match="trials is 3 there, 5 here.*another --out"):
        claim(tmp_path, Settings(trials=5), 0)
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(ValueError, match="not the record of a run"):
        claim(tmp_path, Settings(), 0)


def test_an_estimate_is_said_and_missing_memory_is_warned_of(capsys):
    announce(Console(), "training", Estimate(seconds=130, memory_bytes=2e9))
    assert capsys.readouterr().err == "training: about 2 min 10 s and 2.0 GB of memory\n"
    announce(Console(), "training", Estimate(seconds=1, memory_bytes=1e18))
    assert "warning" in capsys.readouterr().err

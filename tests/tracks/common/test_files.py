"""Files appear whole or not at all, and the JSON we write is strict."""

import errno
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from tracks.common import files


@pytest.mark.parametrize("replacing", [files.replacing_file, files.replacing_folder])
def test_a_failed_write_is_named_and_leaves_what_was_there_and_nothing_beside_it(
    tmp_path, replacing
):
    def file_of(place):
        return place / "it" if place.is_dir() else place

    target = tmp_path / "a.json"
    with replacing(target) as beside:
        file_of(beside).write_text("old")
    with pytest.raises(OSError, match="No space.*a.json"), replacing(target) as beside:
        file_of(beside).write_text("half")
        assert file_of(target).read_text() == "old"
        raise OSError(errno.ENOSPC, "No space left on device")
    assert file_of(target).read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_files_and_folders_are_replaced_whole_and_missing_folders_made(tmp_path):
    target, folder = tmp_path / "deep" / "b.parquet", tmp_path / "deep" / "checkpoint"
    with files.replacing_file(target) as beside:
        assert beside.suffix == ".parquet" and not target.exists()
        beside.write_bytes(b"x")
    assert target.read_bytes() == b"x"
    for step in ("1", "2"):
        with files.replacing_folder(folder) as beside:
            (beside / f"step_{step}").write_text(step)
    assert [p.name for p in folder.iterdir()] == ["step_2"]
    assert {p.name for p in folder.parent.iterdir()} == {"b.parquet", "checkpoint"}


@dataclass
class Config:
    rate: float


class Pair(NamedTuple):
    left: int
    right: object


def test_json_is_strict_and_takes_what_the_suite_holds():
    held = [float("nan"), np.array([1.0, np.inf]), np.float32(0.5), np.bool_(True), {1}]
    assert json.loads(files.to_json({3: held})) == {"3": [None, [1.0, None], 0.5, True, [1]]}
    named = {"config": Config(30.0), "pair": Pair(1, Path("x"))}
    expected = {"config": {"rate": 30.0}, "pair": {"left": 1, "right": "x"}}
    assert json.loads(files.to_json(named)) == expected


DEAD = 2**22 + 1
"""A process number that no process has."""


def part_of(folder, name, writer, *inside):
    """Make what the process `writer` is writing, or left: a folder with folders `inside`."""
    part = folder / f".{name}-{writer}abcdefg_.part"
    for each in inside or ("half",):
        (part / each).mkdir(parents=True)
    return part


def test_what_killed_processes_left_is_swept_and_what_is_being_written_stays(tmp_path):
    dead = part_of(tmp_path, "a.json", f"{DEAD}-")
    older = part_of(tmp_path / "deep" / "er", "b.json", "")
    alive = part_of(tmp_path, "c.json", f"{os.getpid()}-")
    other = tmp_path / ".hidden.part"
    other.mkdir()
    assert set(files.sweep_parts(tmp_path)) == {dead, older}
    assert alive.exists() and other.exists() and not dead.exists() and not older.exists()


@pytest.mark.parametrize(
    ("writer", "alive"), [(DEAD, False), (os.getpid(), True)], ids=["dead", "alive"]
)
def test_a_whole_folder_left_aside_is_put_in_place_unless_its_writer_lives(tmp_path, writer, alive):
    part = part_of(tmp_path, "state", f"{writer}-", "replaced", "state/new")
    files.sweep_parts(tmp_path)
    files.recover_folder(tmp_path / "state")
    assert part.exists() == alive and (tmp_path / "state" / "new").exists() != alive


def test_a_place_is_tried_before_the_work_and_left_as_it_was(tmp_path):
    files.check_place(tmp_path / "a" / "b" / "c.rrd")
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    for bad in (tmp_path, tmp_path / "file" / "x.rrd", tmp_path / ("y" * 300), "/proc/nowhere/x"):
        with pytest.raises(OSError):
            files.check_place(bad)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_file_that_is_read_is_refused_as_one_to_write_by_whatever_name(tmp_path):
    given, link = tmp_path / "a.toml", tmp_path / "b.toml"
    files.check_no_input(given, [given, None, "", "reference"], "--out")
    given.write_text("x")
    link.symlink_to(given)
    files.check_no_input(given, [None, "", "reference", tmp_path / "none.toml"], "--out")
    files.check_no_input(tmp_path / "new.toml", [given], "--out")
    for path in (given, link, tmp_path / "." / "a.toml"):
        with pytest.raises(ValueError, match="--out: .* is also an input .* give another --out"):
            files.check_no_input(path, [given], "--out")

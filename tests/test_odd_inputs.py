"""Unusable input of users and other programs: exit 2, a message of one line, no files left.

Every case is a whole command line in this process. Options and settings out of range are in
tests/suite/test_cli.py; models that hang or abort, in tests/policies/formats/test_model_process.py.
"""

import errno
import os
import re
import shutil
from functools import partial
from itertools import product
from pathlib import Path

import pytest

import suite
from policies import shipped
from suite import cli
from suite.diagnose import example
from tests.support.commands import refused
from tests.support.mutations import DEEP
from tracks.input.reading import read_toml

EXAMPLE = Path(example.__file__).parent


def checkpoint(folder):
    """Return a copy of a shipped policy."""
    return Path(shutil.copytree(shipped.locate("race-paper"), folder / "policy"))


READ = {
    "weights": ("policy/weights.safetensors", "eval --policy policy --trials 1"),
    "settings of a policy": ("policy/config.json", "eval --policy policy --trials 1"),
    "model": ("it.onnx", "eval --policy it.onnx --trials 1"),
    "program": ("it.pt2", "eval --policy it.pt2 --trust --trials 1"),
    "script": ("it.pt", "eval --policy it.pt --trust --trials 1"),
    "policy to start from": ("policy/weights.safetensors", "train --init-from policy"),
    "policy to export": ("policy/config.json", "export --policy policy"),
    "Delta Action Model": ("policy/config.json", "train --delta policy"),
    "vehicle": ("it.toml", "eval --vehicle it.toml --trials 1"),
    "vehicle to train with": ("it.toml", "train --model quad --vehicle it.toml"),
    "track": ("it.toml", "eval --track it.toml --trials 1"),
    "Parquet log": ("it.parquet", "diagnose it.parquet --vehicle reference"),
    "CSV log": ("it.csv", "diagnose it.csv --vehicle reference"),
    "foreign log": ("it.ulg", "import it.ulg"),
    "mapping": ("it.toml", "import log.csv --map it.toml"),
    "evaluation": ("run/run.json", "view run"),
}
"""A kind of file, its place, and a command that reads it."""
LOGS = ("Parquet log", "CSV log")
"""Kinds of which a folder with many may be given."""


def at_its_place(what, folder, monkeypatch):
    """Return the path of a kind of file among all that its command needs, and the command line."""
    name, line = READ[what]
    monkeypatch.chdir(folder)
    if "policy" in line:
        checkpoint(folder)
    (folder / "log.csv").write_text("t,x\n0,1\n")
    (folder / "run").mkdir()
    (folder / "run" / "trials.parquet").touch()
    out = "out.parquet" if line.startswith("import") else "out"
    return folder / name, [*line.split(), "--out", out]


KINDS = ("pipe", "link to an endless device", "folder", "3 GB")
ODD_FILES = [
    (what, kind) for what in READ for kind in KINDS if what not in LOGS or kind != "folder"
]


@pytest.mark.parametrize(("what", "kind"), ODD_FILES)
def test_what_is_no_file_of_a_sensible_size_is_refused_unread(
    what, kind, tmp_path, monkeypatch, capsys
):
    path, line = at_its_place(what, tmp_path, monkeypatch)
    path.unlink(missing_ok=True)
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
        case "3 GB":
            with path.open("wb") as file:
                file.truncate(3 * 2**30)  # a hole: takes no room on the disk
        case _:
            path.symlink_to("/dev/zero")
    said = refused(capsys, "", *line)
    assert path.name in said
    assert not list(tmp_path.glob("out*"))


CONTENT = {
    "deep": (DEEP, "x = " + DEEP),
    "a number of hundreds of digits": ('{"schema": ' + "9" * 5000 + "}", "mass = " + "9" * 5000),
    "a NUL in a name": ('{"a\0": 1}', 'name = "a\0b"'),
    "no UTF-8": ('{"a": "\udcff"}', 'name = "\udcff"'),
    "empty": ("", ""),
}
"""Text as JSON and as TOML."""


OTHERS = {
    "utf-16": ("a,b\n1,2\n3,4\n".encode("utf-16"), "text in UTF-16"),
    "utf-16-be": ("a,b\n1,2\n3,4\n".encode("utf-16-be"), "text in UTF-16"),
    "gzip": (b"\x1f\x8b\x08\0", "compressed by gzip"),
    "Excel": (b"PK\3\4\x14\0", "an Excel workbook"),
    "Git LFS": (b"version https://git-lfs.github.com/spec/v1\n", "run git lfs pull"),
    "page": (b"<!DOCTYPE html>\n<html><title>Not found</title>", "a web page"),
}


WRONG = [
    *product(("settings of a policy", "vehicle", "track", "mapping", "evaluation"), CONTENT),
    *product(("vehicle", "CSV log", "Parquet log", "foreign log"), OTHERS),
]


@pytest.mark.parametrize(("what", "content"), WRONG)
def test_damaged_text_is_refused_and_other_formats_are_called_what_they_are(
    what, content, tmp_path, monkeypatch, capsys
):
    path, line = at_its_place(what, tmp_path, monkeypatch)
    damaged = CONTENT.get(content, ("", ""))[path.suffix == ".toml"]
    data, words = OTHERS.get(content, (damaged.encode(errors="surrogateescape"), ""))
    path.write_bytes(data)
    said = refused(capsys, "", *line)
    assert words in said
    assert ("log.csv" if (what, content) == ("mapping", "empty") else path.name) in said
    assert not list(tmp_path.glob("out*"))


def test_a_toml_file_with_the_mark_of_windows_is_read(tmp_path):
    text = (Path(cli.__file__).parents[1] / "eval/vehicles/racer5.toml").read_text("utf-8")
    (tmp_path / "it.toml").write_text(text.replace("\n", "\r\n"), "utf-8-sig")
    assert read_toml(tmp_path / "it.toml")["name"] == "racer5"


WRITERS = {
    "eval": "eval --trials 1",
    "train": "train --recipe quick --iterations 1",
    "collect": "collect --trials 1",
    "tracks": "tracks zigzag",
    "export": "export --policy race-paper --format onnx",
    "delta": f"delta {EXAMPLE}",
    "diagnose": f"diagnose {EXAMPLE} --vehicle reference",
    "loop": "loop",
    "blind": "blind make --count 1",
    "reproduce": "reproduce table2",
}
"""Commands that write into --out."""
PLACES = {
    "a read-only file system": "read-only/out",
    "a file": "file",
    "below a file": "file/out",
    "a device": "/dev/null",
    "a name too long": "x" * 300,
    "a NUL": "a\0b",
    "a link to itself": "circle",
}


WRITTEN = [(command, place) for command in WRITERS for place in PLACES]
WRITTEN = [each for each in WRITTEN if each[0] == "eval" or "file" in each[1]]
"""All places for one command, and for each other command those that people meet most."""


@pytest.mark.parametrize(("command", "place"), WRITTEN)
def test_a_place_that_cannot_be_written_is_refused(command, place, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("kept")
    Path("circle").symlink_to("circle")
    Path("read-only").mkdir()
    mkdir = os.mkdir

    def on_read_only(path, *args, **kwargs):
        if "read-only" in Path(os.fsdecode(path)).parts:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), os.fsdecode(path))
        return mkdir(path, *args, **kwargs)

    monkeypatch.setattr(os, "mkdir", on_read_only)
    refused(capsys, WRITERS[command], "--out", PLACES[place])
    assert Path("file").read_text() == "kept"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["circle", "file", "read-only"]


def test_python_names_its_own_arguments_and_not_options_of_commands(tmp_path):
    fly, train = suite.evaluate_policy, partial(suite.train_policy, tmp_path / "out", "quick")
    for call, said in (
        (partial(fly, trials=0), "trials is 0, allowed is 1 to"),
        (partial(fly, seed=-1), "seed is -1, allowed is 0 to"),
        (partial(fly, difficulty="easy"), "difficulty 'easy': 'easy' is no level"),
        (partial(fly, workers=0), "workers is 0, allowed is 1 to 256"),
        (partial(fly, workers="2"), "workers is '2', allowed is a whole number, 1 to 256"),
        (partial(train, settings=["los.progress=1"]), "settings 'los.progress=1': unknown"),
        (partial(train, seed=-1), "seed is -1, allowed is 0 to"),
        (partial(suite.diagnose_flights, [], "racer5", tmp_path / "out"), "flights is empty, allo"),
    ):
        with pytest.raises(ValueError, match=f"^{re.escape(said)}"):
            call()
    assert not (tmp_path / "out").exists()

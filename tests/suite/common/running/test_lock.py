"""One writer a folder: a second one is refused, and a dead one blocks nobody."""

import contextlib
import json
import os
import subprocess
import sys
import textwrap
import threading

import pytest

from suite.common.running.lock import HOLDER, LOCK, one_writer, one_writer_each
from tests.support.commands import refused


def test_the_second_is_told_who_was_first_and_a_holder_that_says_nothing_still_holds(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(sys, "argv", ["/bin/suite", "eval", "--out", "a b"])
    with one_writer(tmp_path / "run"):
        words = rf"run is being written by `suite eval --out 'a b'` \(pid {os.getpid()} on .*since"
        with pytest.raises(ValueError, match=words):
            with one_writer(tmp_path / "run"):
                pass
        with one_writer(tmp_path / "other"):
            pass
    with one_writer(tmp_path / "run"):
        pass
    for text in ("", "[" * 100_000, "[]", '{"command": "\x1b[31m", "pid": 1}'):
        with one_writer(tmp_path):
            (tmp_path / HOLDER).write_text(text)
            with pytest.raises(ValueError, match="being written by another command"):
                with one_writer(tmp_path):
                    pass


def test_a_lock_that_a_killed_command_left_is_taken_over_and_an_empty_folder_is_not_left(tmp_path):
    (tmp_path / LOCK).touch()
    (tmp_path / HOLDER).write_text('{"command": "suite train", "pid": 1, "host": "x"}')
    with one_writer(tmp_path):
        assert json.loads((tmp_path / HOLDER).read_text())["pid"] == os.getpid()
    assert not list(tmp_path.iterdir())
    with pytest.raises(KeyError):
        with one_writer_each([tmp_path / "a" / "b", tmp_path / "a" / ".." / "a" / "b"]):
            raise KeyError
    assert not list(tmp_path.iterdir())
    with one_writer(tmp_path / "a"):
        (tmp_path / "a" / "result").touch()
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["result"]


def test_files_of_others_are_left_as_they_are(tmp_path):
    """Neither a lock of another program, nor what a link of our lock's name leads to."""
    (tmp_path / LOCK).write_text("foreign")
    with pytest.raises(ValueError, match="is not a lock of the suite"):
        with one_writer(tmp_path):
            pass
    assert (tmp_path / LOCK).read_text() == "foreign"
    (tmp_path / LOCK).unlink()
    (tmp_path / ".lock").write_text("another program's")
    (tmp_path / "target").write_text("precious")
    for name in (LOCK, HOLDER, ".lock"):
        with contextlib.suppress(FileExistsError):
            os.link(tmp_path / "target", tmp_path / name)
        with contextlib.suppress(ValueError):
            with one_writer(tmp_path):
                pass
        assert (tmp_path / "target").read_text() == "precious"
        assert (tmp_path / ".lock").read_text() == "another program's"
        (tmp_path / LOCK).unlink(missing_ok=True)


def test_the_lock_is_gone_before_it_is_free(tmp_path, monkeypatch):
    """Who comes when the file is being taken away must not get in: its own would go as well."""
    unlink, met = os.unlink, []

    def contend(path, *args, **kwargs):
        if os.fspath(path).endswith(LOCK) and not met:
            met.append(True)
            with pytest.raises(ValueError, match="is being written"):
                with one_writer(tmp_path / "run"):
                    pass
        unlink(path, *args, **kwargs)

    monkeypatch.setattr(os, "unlink", contend)
    with one_writer(tmp_path / "run"):
        (tmp_path / "run" / "result").touch()
    assert met


def test_of_many_that_come_and_go_one_is_inside(tmp_path):
    inside, twice, done, foreign = [], [], [], []

    def come_and_go():
        while len(done) < 30 and not twice:
            try:
                with one_writer(tmp_path):
                    inside.append(1)
                    twice.extend(inside[1:])
                    done.append(1)
                    inside.pop()
            except ValueError as error:
                foreign.extend(["not the suite's"] * ("not the suite's" in str(error)))

    threads = [threading.Thread(target=come_and_go) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not twice and not foreign


def test_a_kill_frees_the_folder_and_what_it_left_is_swept(tmp_path):
    code = textwrap.dedent(f"""
        import os, signal
        from pathlib import Path
        from suite.common.running.lock import one_writer
        from tracks.common.files import replacing_file
        with one_writer(Path({str(tmp_path)!r})):
            with replacing_file({str(tmp_path / "sub" / "big.bin")!r}) as beside:
                beside.write_bytes(b"half")
                os.kill(os.getpid(), signal.SIGKILL)
    """)
    done = subprocess.run([sys.executable, "-c", code])
    assert done.returncode == -9
    assert (tmp_path / LOCK).exists() and len(list((tmp_path / "sub").iterdir())) == 1
    with one_writer(tmp_path):
        assert not list((tmp_path / "sub").iterdir())


def test_every_command_that_writes_much_asks_first(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for line in (
        *("train --recipe quick", "eval --trials 1", "collect", "delta nothing"),
        *("loop --recipe quick", "diagnose nothing --vehicle reference", "reproduce table2"),
        *("blind make --count 1", "blind run"),
    ):
        with one_writer(tmp_path / "out"):
            assert "is being written by" in refused(capsys, f"{line} --out out")

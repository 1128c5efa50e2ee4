"""One writer a folder, signals end a command in seconds, jobs on machines without our folders."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from functools import partial
from pathlib import Path

import pytest

from suite.common.running import interrupts
from suite.common.running.interrupts import ends_in_seconds
from suite.common.running.lock import HOLDER, LOCK, one_writer, one_writer_each
from suite.common.running.remote import Job, content, do_remotely, parcels, replace_content
from tests.support.commands import refused


def locked(folder, words):
    """Another writer of the folder is refused with these words."""
    with pytest.raises(ValueError, match=words), one_writer(folder):
        pass


def test_the_second_is_told_who_was_first_and_a_holder_that_says_nothing_still_holds(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(sys, "argv", ["/bin/suite", "eval", "--out", "a b"])
    with one_writer(tmp_path / "run"):
        words = rf"run is being written by `suite eval --out 'a b'` \(pid {os.getpid()} on .*since"
        locked(tmp_path / "run", words)
        with one_writer(tmp_path / "other"):
            pass
    with one_writer(tmp_path / "run"):
        pass
    for text in ("", "[" * 100_000, "[]", '{"command": "\x1b[31m", "pid": 1}'):
        with one_writer(tmp_path):
            (tmp_path / HOLDER).write_text(text)
            locked(tmp_path, "being written by another command")


def test_a_lock_that_a_killed_command_left_is_taken_over_and_an_empty_folder_is_not_left(tmp_path):
    (tmp_path / LOCK).touch()
    (tmp_path / HOLDER).write_text('{"command": "suite train", "pid": 1, "host": "x"}')
    with one_writer(tmp_path):
        assert json.loads((tmp_path / HOLDER).read_text())["pid"] == os.getpid()
    assert not list(tmp_path.iterdir())
    same = [tmp_path / "a" / "b", tmp_path / "a" / ".." / "a" / "b"]
    with pytest.raises(KeyError), one_writer_each(same):
        raise KeyError
    assert not list(tmp_path.iterdir())
    with one_writer(tmp_path / "a"):
        (tmp_path / "a" / "result").touch()
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["result"]


def test_files_of_others_are_left_as_they_are(tmp_path):
    """Neither a lock of another program, nor what a link of our lock's name leads to."""
    (tmp_path / LOCK).write_text("foreign")
    locked(tmp_path, "is not a lock of the suite")
    assert (tmp_path / LOCK).read_text() == "foreign"
    (tmp_path / LOCK).unlink()
    (tmp_path / ".lock").write_text("another program's")
    (tmp_path / "target").write_text("precious")
    for name in (LOCK, HOLDER, ".lock"):
        with contextlib.suppress(FileExistsError):
            os.link(tmp_path / "target", tmp_path / name)
        with contextlib.suppress(ValueError), one_writer(tmp_path):
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
            locked(tmp_path / "run", "is being written")
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


IN_C = """
    import ctypes, os, signal, threading
    from suite.common.running import interrupts

    # A shell that starts the tests in the background has them ignore Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    interrupts.PATIENCE_S = 0.3
    lock, mutex = ctypes.CDLL(None).pthread_mutex_lock, ctypes.create_string_buffer(64)
    lock(mutex)
    with interrupts.ends_in_seconds():
        threading.Timer(0.2, os.kill, (os.getpid(), signal.{number})).start()
        # A wait in C that no signal cuts short, as little as it does a compiler.
        lock(mutex)
"""


def test_what_python_cannot_stop_is_ended():
    codes = [textwrap.dedent(IN_C).format(number=number) for number in ("SIGINT", "SIGTERM")]
    both = [
        subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
        for code in codes
    ]
    for process in both:
        assert process.communicate(timeout=15)[1] == interrupts.MESSAGE
        assert process.returncode == 130


def test_what_python_can_stop_is_interrupted_and_cleaned_up():
    before = signal.getsignal(signal.SIGTERM)
    threads = threading.active_count()
    with pytest.raises(KeyboardInterrupt), ends_in_seconds():
        os.kill(os.getpid(), signal.SIGTERM)
        signal.pause()
    assert signal.getsignal(signal.SIGTERM) == before and threading.active_count() == threads


class Tired:
    """Gets the signal to end while it is freed, where Python cannot raise an error."""

    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.1)


def test_an_interrupt_that_python_loses_is_sent_again(capfd):
    hook, reached = sys.unraisablehook, []
    with pytest.raises(KeyboardInterrupt), ends_in_seconds():
        Tired()
        reached.append("past the lost one")
        time.sleep(10.0)
        reached.append("the end")
    assert reached == ["past the lost one"] and sys.unraisablehook is hook
    assert capfd.readouterr().err == ""


def test_an_interrupt_that_a_library_swallows_is_sent_again(monkeypatch):
    monkeypatch.setattr(interrupts, "LOST_S", 0.2)
    reached = []
    with pytest.raises(KeyboardInterrupt), ends_in_seconds():
        with contextlib.suppress(BaseException):
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(0.1)
        reached.append("past the lost one")
        time.sleep(10.0)
        reached.append("the end")
    assert reached == ["past the lost one"]


def test_other_threads_and_ignored_signals_are_left_alone():
    met = []

    def elsewhere():
        with ends_in_seconds():
            met.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert met == [signal.getsignal(signal.SIGTERM)]
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with ends_in_seconds():
            os.kill(os.getpid(), signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.fixture
def far(tmp_path, monkeypatch):
    """The user's cache of the other machine."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "far"))
    return tmp_path / "far" / "diffracing-suite" / "pieces"


def count_on(mark, job):
    """Add a line to a file of the job's folder; fail after the first if the job says so."""
    job.folder.mkdir(exist_ok=True)
    with open(job.folder / "lines", "a") as file:
        file.write((job.reads / "deep" / "word").read_text() + "\n")
    if mark and not Path(mark).exists():
        Path(mark).touch()
        raise KeyboardInterrupt
    return job.task


def make_job(folder):
    (folder / "in" / "deep").mkdir(parents=True)
    (folder / "in" / "deep" / "word").write_text("said")
    replace_content(folder / "out", {"lines": b"before\n", "kept/deep": b"1"})
    (folder / "out" / ".lock").touch()
    return Job(7, folder / "out", folder / "in")


def test_a_folder_goes_there_and_comes_back_with_what_was_done(tmp_path, far):
    (parcel,) = parcels([make_job(tmp_path)])
    ((result, files),) = do_remotely(partial(count_on, ""), parcel)
    assert result == 7 and files == {"lines": b"before\nsaid\n", "kept/deep": b"1"}
    assert content(tmp_path / "out")["lines"] == b"before\n" and not list(far.glob("*"))


def test_what_was_cut_off_there_is_gone_on_with_where_no_other_works(tmp_path, far):
    (parcel,) = parcels([make_job(tmp_path)])
    work = partial(count_on, str(tmp_path / "mark"))
    with pytest.raises(KeyboardInterrupt):
        list(do_remotely(work, parcel))
    (place,) = far.glob("*")
    with one_writer(place):
        ((_, files),) = do_remotely(work, parcel)
    assert files["lines"] == b"before\nsaid\n"
    assert sorted(os.listdir(place / "out")) == ["kept", "lines"]
    ((_, files),) = do_remotely(work, parcel)
    assert files["lines"] == b"before\nsaid\nsaid\n"

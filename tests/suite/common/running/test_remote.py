"""Jobs on a machine without our folders: their content goes there and comes back."""

import os
from functools import partial
from pathlib import Path

import pytest

from suite.common.running.lock import one_writer
from suite.common.running.remote import Job, content, do_remotely, parcels, replace_content


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

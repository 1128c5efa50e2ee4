"""Two states of the code never share a name."""

import subprocess

import pytest

from tracks.common import provenance


def git(root, *what):
    me = ["-c", "user.name=me", "-c", "user.email=me@here", "-c", "commit.gpgsign=false"]
    subprocess.run(["git", "-C", str(root), *me, *what], check=True, capture_output=True)


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    monkeypatch.setattr(provenance, "_ROOT", tmp_path)
    assert provenance.git_commit.__wrapped__() is None, "a folder without history has no commit"
    git(tmp_path, "init", "--quiet")
    (tmp_path / "code.py").write_text("one\n")
    git(tmp_path, "add", "code.py")
    git(tmp_path, "commit", "--quiet", "-m", "one")
    return tmp_path


def test_what_differs_from_the_commit_is_in_its_name(checkout):
    def name() -> str:
        return provenance.git_commit.__wrapped__() or ""

    clean = name()
    assert len(clean) == 40
    (checkout / "new.txt").write_text("no part of the code")
    assert name() == clean
    (checkout / "code.py").write_text("two\n")
    two = name()
    (checkout / "code.py").write_text("three\n")
    three = name()
    assert len({two, three}) == 2 and all(n.startswith(f"{clean}-dirty-") for n in (two, three))
    (checkout / "code.py").write_text("two\n")
    assert name() == two
    git(checkout, "add", "code.py")
    assert name() == two, "what is staged is as much another state"
    (checkout / "code.py").write_text("one\n")
    assert name() == clean

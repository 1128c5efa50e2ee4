"""The lock, the metadata and the wheel."""

import re
import shutil
import subprocess
import sys
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.support.tools import built_wheel, program
from tracks.common.provenance import VERSION

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
ROOMS = {"tracks", "policies", "eval", "suite"}
LOCK_LINES = [
    line
    for line in (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    if line and not line.startswith("#")
]
LOCK = dict(line.split("==") for line in LOCK_LINES)


def test_the_lock_has_exact_public_versions_of_all_that_the_project_needs():
    exact = re.compile(r"[a-z0-9-]+==[0-9][0-9a-z.]*")
    assert not [line for line in LOCK_LINES if not exact.fullmatch(line)]
    for text in (*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["dev"]):
        wanted = Requirement(text)
        assert wanted.specifier.contains(LOCK[canonicalize_name(wanted.name)]), text
    wanted = PROJECT["dependencies"] + PROJECT["optional-dependencies"]["dev"]
    names = program(ROOT / "tools" / "lock.py").closure(wanted).keys()
    # Platforms differ in what a package needs (torch brings GPU libraries on Linux).
    missing = {n for n in names - LOCK.keys() if not n.startswith(("nvidia-", "cuda-", "triton"))}
    assert not missing


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Build the wheel from a copy: an old build/ in the checkout would leak into it."""
    folder, copy = tmp_path_factory.mktemp("wheel"), tmp_path_factory.mktemp("source")
    for room in ROOMS:
        shutil.copytree(ROOT / room, copy / room, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, copy)
    return built_wheel(copy, folder)


def test_the_wheel_holds_the_four_rooms_and_their_data(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert tops == ROOMS
    shipped = {
        path.relative_to(ROOT).as_posix()
        for room in tops
        for path in (ROOT / room).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert shipped <= set(names), "a file in a room that the wheel leaves out"
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_the_wheel_works_from_an_empty_folder(wheel, tmp_path):
    home = tmp_path / "venv"
    venv.create(home, with_pip=False)
    (site,) = home.glob("lib/python*/site-packages")
    # The requirements come from this environment; the suite itself must come from the wheel.
    zipfile.ZipFile(wheel).extractall(site)
    baked = site / "tracks" / "common" / "built_from.txt"
    assert baked.is_file(), "the build writes the commit into the wheel"
    baked.write_text("0123abc\n")
    installed = [path for path in sys.path if path.endswith("site-packages")]
    (site / "requirements.pth").write_text("\n".join(installed) + "\n")
    empty = tmp_path / "empty"
    empty.mkdir()
    code = (
        "import eval, policies, suite, tracks\n"
        f"for room in (eval, policies, suite, tracks): assert {str(site)!r} in room.__file__\n"
        "from suite.cli import main\n"
        "from tracks.common.provenance import VERSION, git_commit\n"
        "print(VERSION, git_commit())\n"
        "raise SystemExit(main(['list']))\n"
    )
    command = [home / "bin" / "python", "-c", code]
    done = subprocess.run(command, cwd=empty, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"{VERSION} 0123abc\n") and "race-small" in done.stdout
    assert list(empty.iterdir()) == []

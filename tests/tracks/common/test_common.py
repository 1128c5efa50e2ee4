"""Names, tables, masks, TOML and JSON; registries that others add to; files whole or not at all."""

import errno
import io
import json
import os
import subprocess
import sys
import tomllib
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from tracks.common import files, provenance
from tracks.common import names as registry
from tracks.common.figures import rounded, with_unit
from tracks.common.grid import Cell, html_table, markdown, rich_table, table
from tracks.common.masks import everywhere, nowhere, select
from tracks.common.names import Registry, closest, unknown_name
from tracks.common.toml_table import read_toml, to_toml
from tracks.families import FAMILIES, make_track

KEYS = st.text("abcdefgh_", min_size=1, max_size=6)

ENTRIES = st.one_of(
    st.booleans(),
    st.integers(-(2**60), 2**60),
    st.floats(allow_nan=False),
    st.text(st.characters(exclude_categories=["Cs"]), max_size=12),
)

VALUES = ENTRIES | st.lists(ENTRIES, max_size=4)

TABLES = st.recursive(
    st.dictionaries(KEYS, VALUES, max_size=4),
    lambda inside: st.dictionaries(KEYS, st.one_of(VALUES, inside), max_size=4),
    max_leaves=12,
)


EFFECTS = ("linear_drag", "quadratic_drag", "rotor_drag", "motor_lag", "gusts")


def test_a_wrong_name_is_answered_with_the_nearest_and_the_list():
    assert closest("ELIPSE", ["zigzag", "ellipse"]) == "ellipse"
    error = unknown_name("track", "elipse", ["zigzag", "ellipse"])
    assert str(error) == ("unknown track 'elipse'. Did you mean 'ellipse'? Known: zigzag, ellipse.")
    part, none = (str(unknown_name("effect", name, EFFECTS)) for name in ("drag", "xy"))
    assert "Did you mean 'linear_drag', 'quadratic_drag', 'rotor_drag'?" in part
    assert "Did you mean" not in none and "Known: linear_drag" in none


@settings(max_examples=20)
@given(TABLES)
def test_toml_text_reads_back_equal(table):
    assert tomllib.loads(to_toml(table)) == table


def test_a_table_names_the_file_and_the_key_that_is_wrong(tmp_path):
    path = tmp_path / "yard.toml"
    path.write_text("mass = -1\n[gate]\nwidht = 2\n")
    table = read_toml(path)
    with pytest.raises(ValueError, match=r"yard\.toml: mass is -1, allowed is a number above 0"):
        table.number("mass", above=0.0)
    gate = table.table("gate")
    assert gate.number("width", 1.2) == 1.2
    with pytest.raises(ValueError, match=r"'widht' in \[gate\] is unknown. Did you mean 'width'"):
        gate.close()
    with pytest.raises(ValueError, match=r"the file has no 'name'; add it \(a text\)"):
        table.text("name")
    with pytest.raises(ValueError, match=r"has no 'names'; add it \(a list\)"):
        table.value("names", tuple[str, ...])


GRID = table(
    ["name", "v [m/s]"], [["a|b", Cell("<3>", "bad")], ["all", "5 [4, 6]"]], "Title", "Below [1]."
)


def test_a_table_is_written_as_markdown_html_and_on_a_terminal():
    assert markdown(GRID) == (
        "Title\n\n| name | v [m/s] |\n| --- | --- |\n"
        "| a\\|b | <3> |\n| all | 5 [4, 6] |\n\nBelow [1].\n"
    )
    file = io.StringIO()
    Console(width=80, file=file).print(rich_table(GRID))
    assert all(text in file.getvalue() for text in ("Title", "v [m/s]", "<3>", "5 [4, 6]", "[1]."))
    page = html_table(GRID)
    assert "<caption>Title</caption>" in page and '<td class="bad">&lt;3&gt;</td>' in page
    assert 'class="sum"' not in page and '<p class="note">Below [1].</p>' in page
    summed = html_table(replace(GRID, strong_last=True))
    assert '<tr class="sum"><td>all</td>' in summed and summed.count("sum") == 1


@pytest.mark.parametrize("xp", [np, jnp])
@pytest.mark.parametrize("mask", [[True] * 3, [False] * 3, [True, False, True]])
def test_rows_are_chosen_by_a_mask_through_tuples_and_dicts(xp, mask):
    old = {"a": (xp.zeros((3, 2)), -xp.arange(3.0))}
    chosen = select(xp.asarray(mask), {"a": (xp.ones((3, 2)), xp.arange(3.0))}, old)["a"]
    np.testing.assert_array_equal(chosen[0], np.repeat(np.asarray(mask, float)[:, None], 2, 1))
    np.testing.assert_array_equal(chosen[1], np.where(mask, 1.0, -1.0) * np.arange(3.0))
    # Nothing is known of a mask of JAX: its program is the same whatever the mask holds.
    known = [everywhere(xp.asarray(mask)), nowhere(xp.asarray(mask))]
    assert known == ([all(mask), not any(mask)] if xp is np else [False, False])


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


def installed(monkeypatch, **values):
    """Let packages have entry points: name -> (package, value)."""
    found = []
    for name, (package, value) in values.items():
        entry = EntryPoint(name, value, "things")
        vars(entry).update(dist=SimpleNamespace(name=package))
        found.append(entry)
    monkeypatch.setattr(registry, "_installed", lambda: EntryPoints(found))


def registry_of(**own):
    def check(name, value):
        return None if value else "nothing there"

    return Registry("thing", "things", own, check)


def test_ours_come_first_and_in_order_and_added_ones_after(monkeypatch):
    installed(monkeypatch, b=("two", "math:pi"), a=("one", "math:e"))
    found = registry_of(z=1, y="math:tau")
    found.register("x", 5)
    assert list(found) == ["z", "y", "a", "b", "x"] and len(found) == 5
    assert found["y"] == pytest.approx(6.283, abs=1e-3)
    assert found["b"] == pytest.approx(3.1416, abs=1e-4)


def test_an_added_name_must_be_one_that_files_can_hold(monkeypatch):
    """A sensor model's name is a table of a sensors file, as an effect's is of a vehicle file."""
    installed(monkeypatch, **{"a fin": ("one", "math:e")})
    found = registry_of(z=1)
    with pytest.raises(ValueError, match=r"thing 'a fin' \(.*letters without accents"):
        found["a fin"]
    with pytest.raises(ValueError, match=r"thing 'tür' \(register\): .*letters without accents"):
        found.register("tür", 5)
    assert found.own == {"z"}


def test_one_of_ours_is_found_without_asking_packages_or_importing(monkeypatch):
    monkeypatch.setattr(registry, "_installed", lambda: pytest.fail("asked"))
    sys.modules.pop("wave", None)
    found = registry_of(z=1, late="wave")
    assert found["z"] == 1 and "late" in found and found.find("z") == 1
    assert "wave" not in sys.modules
    assert found["late"].__name__ == "wave"


def test_a_name_is_given_once(monkeypatch):
    installed(monkeypatch, a=("one", "math:e"))
    found = registry_of(z=1)
    for name in ("z", "a"):
        with pytest.raises(ValueError, match=f"thing '{name}' exists already"):
            found.register(name, 2)
    installed(monkeypatch, z=("one", "math:e"))
    with pytest.raises(ValueError, match="'z' of the package 'one'.*the suite too.*rename"):
        list(registry_of(z=1))


def test_unknown_broken_and_wrong_entries_say_what_to_do(monkeypatch):
    installed(monkeypatch, a=("one", "no_such_module:x"), b=("two", "math:e"))
    found = registry_of(zebra=1)
    with pytest.raises(ValueError, match="unknown thing 'zebr'.*'zebra'.*Known: zebra, a, b"):
        found.find("zebr")
    with pytest.raises(KeyError):
        found["zebr"]
    with pytest.raises(ValueError, match="'a' of the package 'one'.*ModuleNotFound.*uninstall"):
        found["a"]
    with pytest.raises(ValueError, match="thing 'nil'.*nothing there"):
        found.register("nil", 0)


def test_a_family_whose_name_a_command_would_divide_is_refused():
    with pytest.raises(ValueError, match="track family 'a,b' .*allowed are letters"):
        FAMILIES.register("a,b", make_track)


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
    with pytest.raises(IsADirectoryError) as error, files.replacing_file(tmp_path):
        pass
    assert error.value.filename == str(tmp_path)


def test_a_file_that_is_read_is_refused_as_one_to_write_by_whatever_name(tmp_path):
    given, link = tmp_path / "a.toml", tmp_path / "b.toml"
    files.check_no_input(given, [given, None, "", "reference"])
    given.write_text("x")
    link.symlink_to(given)
    files.check_no_input(given, [None, "", "reference", tmp_path / "none.toml"])
    files.check_no_input(tmp_path / "new.toml", [given])
    for path in (given, link, tmp_path / "." / "a.toml"):
        with pytest.raises(ValueError, match="--out: .* is also an input .* give another --out"):
            files.check_no_input(path, [given])


def test_a_number_for_people_has_no_power_of_ten_and_a_ratio_no_unit():
    assert [rounded(value, 2) for value in (0.0123, 12.3, 99.7, 123.4, -1234.5)] == [
        "0.012", "12", "100", "123", "-1,234"
    ]  # fmt: skip
    assert [with_unit("2", unit) for unit in ("1", "", "1/s")] == ["2", "2", "2 1/s"]

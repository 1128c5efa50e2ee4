"""The small pieces that every room leans on."""

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracks.common.names import closest, unknown_name
from tracks.common.provenance import VERSION, git_commit, stamp
from tracks.common.toml_table import read_toml, to_toml

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


def test_a_wrong_name_is_answered_with_the_nearest_and_the_list():
    assert closest("ELIPSE", ["zigzag", "ellipse"]) == "ellipse"
    assert closest("quadcopter", ["zigzag", "ellipse"]) is None
    error = unknown_name("track", "elipse", ["zigzag", "ellipse"])
    assert str(error) == ("unknown track 'elipse'. Did you mean 'ellipse'? Known: zigzag, ellipse.")


def test_every_header_says_schema_version_commit_and_seed():
    header = stamp(3, 11)
    assert (header["schema"], header["seed"]) == (3, 11)
    assert (header["suite_version"], header["git_commit"]) == (VERSION, git_commit())


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

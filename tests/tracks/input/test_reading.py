"""Files of every kind, size and depth: what is no plain small file is refused before it is read."""

import os
import socket
import tomllib

import pytest

from tracks.input import reading
from tracks.input.reading import (
    InputError,
    check_file,
    parse_json,
    read_bytes,
    read_json,
    read_toml,
)


def test_a_plain_file_is_read(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"a": [1, {"b": null}]}')
    check_file(path, 100)
    assert read_json(path) == {"a": [1, {"b": None}]}
    path.write_text("a = 1\nb.c = 'é'", encoding="utf-8")
    assert read_toml(path) == {"a": 1, "b": {"c": "é"}}


def _odd(folder, kind):
    path = folder / "odd"
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "link to a device":
            path.symlink_to("/dev/zero")
        case "folder":
            path.mkdir()
        case "socket":
            with socket.socket(socket.AF_UNIX) as bound:
                bound.bind(str(path))
    return path


@pytest.mark.parametrize("kind", ["pipe", "link to a device", "folder"])
@pytest.mark.parametrize("read", [read_bytes, read_json, read_toml, lambda p: check_file(p, 9)])
def test_what_is_no_plain_file_is_refused_without_waiting(tmp_path, kind, read):
    path = _odd(tmp_path, kind)
    with pytest.raises(InputError, match=rf"odd: cannot be read: it is a .*{kind.split()[-1]}"):
        read(path)


def test_a_link_to_itself_and_a_name_too_long_are_the_systems_errors(tmp_path):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name in ("loop", "x" * 300, "nowhere"):
        with pytest.raises(OSError):
            read_bytes(tmp_path / name)


def test_a_file_of_gigabytes_is_refused_unread(tmp_path):
    path = tmp_path / "large"
    with path.open("wb") as file:
        file.truncate(3 * 2**30)  # a hole: takes no room on the disk
    with pytest.raises(InputError, match=f"has {3 * 2**30} bytes, allowed are up to {2**26}"):
        read_bytes(path)


def test_a_file_that_says_it_is_empty_is_read_to_its_limit():
    if not os.path.exists("/proc/self/maps"):
        pytest.skip("no /proc")
    with pytest.raises(InputError, match="has more bytes"):
        read_bytes("/proc/self/maps", 10)


DEEP = 100_000


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[" * DEEP + "]" * DEEP, "nested deeper than the 64"),
        ("[" * 70 + "]" * 70, "nested deeper"),
        ('{"a":' * DEEP + "1" + "}" * DEEP, "nested deeper"),
        ("9" * 5000, "not JSON .*4300"),
        ('{"a": ', "not JSON"),
        (b"\xff\xfe\xfd", "not JSON"),
        ("", "not JSON"),
    ],
)
def test_json_of_any_sort_is_read_or_refused(text, words):
    with pytest.raises(InputError, match=f"here: .*{words}"):
        parse_json(text, "here")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "[" * DEEP + "]" * DEEP, "nested deeper"),
        (".".join(["a"] * 2000) + " = 1", "nested deeper"),
        ("a = " + "9" * 5000, "is not TOML: .*4300"),
        ("a = = 1", "is not TOML"),
        (b"a = '\xff'", "is not TOML"),
        ("a\0 = 1", "is not TOML"),
    ],
)
def test_toml_of_any_sort_is_read_or_refused(tmp_path, text, words):
    path = tmp_path / "a.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=f"a.toml: .*{words}"):
        read_toml(path)
    assert tomllib.loads("a = 1") and reading.reason(OSError(2, "No such file")) == "No such file"

"""Hypothesis strategies: valid files of every kind, changed a little or beyond recognition."""

import json
from collections.abc import Iterator
from typing import Any

from hypothesis import strategies as st

DEEP = "[" * 3000 + "]" * 3000
NUMBERS = (
    *("0", "-1", "1e-300", "1e300", "nan", "inf", "-inf", "true", "9" * 400, "9" * 5000, "0.5"),
    *("9223372036854775808", "-0.0", "1e400"),
)
TEXTS = ('""', '"x"', '"a\\u0000b"', '"' + "x" * 5000 + '"', '"../../etc/passwd"', '"/dev/zero"')
OTHERS = ("[]", "{}", "[1, 2]", "[0.0, 0.0, 0.0]", "[1e300, 1e300, 1e300]", "[[]]", DEEP)
JSON_ONLY = ("null", "NaN", "Infinity")


def mutated_bytes(valid: bytes) -> st.SearchStrategy[bytes]:
    """Return `valid` with one to four places overwritten, cut out, doubled or filled.

    Half of them are in the first 2000 bytes, where most formats say what follows.
    """
    last = max(len(valid) - 1, 0)
    place = st.one_of(st.integers(0, last), st.integers(0, min(last, 2000)))
    length = st.integers(0, 64)
    change = st.tuples(st.sampled_from("wxdtz"), place, length, st.binary(max_size=16))

    def apply(changes: list[tuple[str, int, int, bytes]]) -> bytes:
        data = valid
        for kind, at, count, new in changes:
            before, cut, after = data[:at], data[at : at + count], data[at + count :]
            data = {
                "w": before + new + data[at + len(new) :],
                "x": before + after,
                "d": before + cut * 3 + after,
                "t": before,
                "z": before + new * 200 + data[at:],
            }[kind]
        return data

    return st.lists(change, min_size=1, max_size=4).map(apply)


def mutated_toml(valid: str) -> st.SearchStrategy[bytes]:
    """Return a TOML text with values replaced, lines lost, doubled or moved, or bytes changed."""
    lines = valid.splitlines()
    keys = [i for i, line in enumerate(lines) if "=" in line]
    value = st.sampled_from((*NUMBERS, *TEXTS, *OTHERS, "2020-01-01", "{a.b.c = 1}", "= ="))

    def replaced(drawn: tuple[list[int], list[str]]) -> bytes:
        changed = list(lines)
        for at, new in zip(*drawn, strict=False):
            changed[at] = changed[at].split("=")[0] + "= " + new
        return "\n".join(changed).encode()

    def moved(order: list[int]) -> bytes:
        return "\n".join(lines[i] for i in order).encode()

    chosen = st.lists(st.sampled_from(keys), min_size=1, max_size=3)
    return st.one_of(
        st.tuples(chosen, st.lists(value, min_size=3, max_size=3)).map(replaced),
        st.lists(st.integers(0, len(lines) - 1), max_size=len(lines) + 3).map(moved),
        mutated_bytes(valid.encode()),
    )


def mutated_json(valid: Any) -> st.SearchStrategy[bytes]:
    """Return a JSON text with a value replaced or a key lost, or bytes changed."""
    paths = list(_paths(valid))
    mark = "\ue000"
    value = st.sampled_from((*NUMBERS, *TEXTS, *OTHERS, *JSON_ONLY, "{" * 2000))

    def replaced(drawn: tuple[tuple[Any, ...], str | None]) -> bytes:
        path, new = drawn
        tree = json.loads(json.dumps(valid))
        inner = tree
        for key in path[:-1]:
            inner = inner[key]
        if new is None:
            del inner[path[-1]]
        else:
            inner[path[-1]] = mark
        text = json.dumps(tree, ensure_ascii=False)
        return text.replace(f'"{mark}"', new or "").encode()

    return st.one_of(
        st.tuples(st.sampled_from(paths), st.one_of(st.none(), value)).map(replaced),
        mutated_bytes(json.dumps(valid).encode()),
    )


def settings_of(config: Any, path: str = "") -> Iterator[str]:
    """Yield the dotted names of all settings of a configuration."""
    for name, value in vars(config).items():
        if hasattr(value, "__dataclass_fields__"):
            yield from settings_of(value, f"{path}{name}.")
        yield path + name


def changes(config: Any) -> st.SearchStrategy[str]:
    """Return one change as --set takes it: any setting, most of any value."""
    odd = (*NUMBERS, *TEXTS, *OTHERS, "(1, 2)", "(2.0, 1.0)", "(0.0, 1e400)", "((", "x" * 5000, "")
    value = st.one_of(
        st.sampled_from(odd),
        st.integers().map(str),
        st.floats().map(repr),
        st.tuples(st.floats(), st.floats()).map(repr),
        st.text(max_size=20),
    )
    name = st.one_of(st.sampled_from(sorted(settings_of(config))), st.text(max_size=20))
    return st.tuples(name, st.sampled_from(["=", "=", "=", "", "=="]), value).map("".join)


def _paths(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    items = value.items() if isinstance(value, dict) else enumerate(value)
    for key, below in items:
        yield (*path, key)
        if isinstance(below, dict | list):
            yield from _paths(below, (*path, key))

"""Every number of every configuration has its range; text of any sort is read or refused.

What is no plain file of a sensible size is in tests/test_odd_inputs.py, with all that reads one.
"""

import dataclasses
import importlib
import math
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

import numpy as np
import pytest

from policies.shipped import locate
from suite.cli import COMMANDS
from suite.delta.fit import FitConfig
from suite.experiments import EXPERIMENTS
from suite.train.config import QuadrotorConfig, TrainConfig
from suite.train.ppo.config import PpoConfig
from tracks.common.toml_table import to_toml
from tracks.geometry.camera import Camera
from tracks.input.ranges import Range, as_path, check_ranges, is_finite, is_number, shown
from tracks.input.reading import InputError, read_bytes, read_json, read_toml

TWO = "allowed is a tuple of 2 numbers, each 1 to 179$"


@dataclass(frozen=True)
class Inner:
    span: Annotated[tuple[float, float], Range(0.0, 2.0, ordered=True)] = (0.0, 1.0)
    depth: Annotated[float, Range(0.0, math.inf)] = math.inf


@dataclass(frozen=True)
class Outer:
    inner: Inner = dataclasses.field(default_factory=Inner)
    late_s: Annotated[float, Range(0.0, 10.0, above=True)] | None = None
    seeds: tuple[Annotated[int, Range(0, 9)], ...] = ()
    camera: Camera = Camera()


INNER: Any = Inner
OUTER: Any = Outer
CAMERA: Any = Camera
"""The classes for values of wrong types, which a type checker refuses."""


@pytest.mark.parametrize(
    ("config", "words"),
    [
        (Outer(late_s=0.0), "^late_s is 0.0, allowed is above 0 to 10$"),
        (Outer(late_s=math.nan), "late_s is nan"),
        (Outer(late_s=math.inf), "late_s is inf"),
        (Outer(late_s=10**400), r"late_s is 10{39}… \(401 characters\), allowed"),
        (Outer(seeds=(1, 10)), r"seeds is \(1, 10\), allowed is 0 to 9"),
        (Outer(Inner(span=(0.0, 2.5))), r"inner.span is \(0.0, 2.5\), allowed is 0 to 2"),
        (Outer(Inner(span=(2.0, 1.0))), "inner.span is .*give the lower end"),
        (Outer(Inner(depth=-1.0)), "inner.depth is -1.0, allowed is 0 and more, inf included"),
        *(
            (OUTER(camera=CAMERA(fov_deg=fov)), f"^camera.fov_deg is {re.escape(repr(fov))}, {TWO}")
            for fov in ([80, 60], (80,), (80, 60, 1), 80, None, ("a", 60), (True, 60))
        ),
        (
            OUTER(seeds=(1, "a")),
            r"seeds is \(1, 'a'\), allowed is a tuple of whole numbers, each 0",
        ),
        (OUTER(INNER(depth=(1.0,))), r"inner.depth is \(1.0,\), allowed is a number, 0 and more"),
        (OUTER(INNER(depth=None)), "inner.depth is None, allowed is a number"),
    ],
)
def test_what_is_outside_of_its_range_is_refused_by_name(config, words):
    check_ranges(Outer())
    with pytest.raises(ValueError, match=words):
        check_ranges(config)
    with pytest.raises(ValueError, match="^--late-s is -1.0"):
        check_ranges(Outer(late_s=-1.0), options=True)


def test_an_empty_text_is_no_path():
    with pytest.raises(ValueError, match="policy is '', allowed is a text or a path"):
        as_path("policy", "")
    assert str(as_path("policy", ".")) == "."


def test_a_path_may_begin_with_the_folder_of_the_user(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert as_path("out", "~/runs") == locate("~/runs") == tmp_path / "runs"
    assert as_path("out", Path("~")) == tmp_path and str(as_path("out", "a/~")) == "a/~"


def test_numbers_of_numpy_are_numbers():
    camera = CAMERA(range_m=np.float32(9), fov_deg=(np.float64(80), np.int64(60)))
    check_ranges(OUTER(late_s=np.float16(1.5), seeds=(np.int8(3),), camera=camera))
    assert is_number(np.float32(1.5)) and is_number(np.int64(3)) and hash(camera)
    assert not any(map(is_number, (np.bool_(True), True, np.float32("nan"), "1", None)))
    assert to_toml({"a": np.float32(1.5), "b": [np.int64(3)]}) == "a = 1.5\nb = [3]\n"


def test_numbers_that_no_float_can_hold_are_shown_short():
    assert not is_finite(10**400) and not is_finite(math.nan) and is_finite(1)
    assert len(shown("x" * 10_000)) < 80
    assert shown([16**10_000]) == "a number of thousands of digits"


def _numbers(cls: type) -> list[str]:
    """Return the fields of a dataclass that are numbers, or tuples or options of them."""

    def is_number(hint: Any) -> bool:
        return hint in (int, float) or any(map(is_number, get_args(hint)))

    return [name for name, hint in get_type_hints(cls).items() if is_number(hint)]


def _dataclasses(cls: type) -> list[type]:
    inside = [
        kind
        for hint in get_type_hints(cls).values()
        for kind in (hint, *get_args(hint))
        if dataclasses.is_dataclass(kind) and kind.__module__.split(".")[0] != "eval"
    ]
    return [cls, *(below for kind in inside for below in _dataclasses(kind))]  # type: ignore[arg-type]


def test_every_number_of_every_configuration_has_its_range():
    modules = [f"suite.commands.{name}" for name in COMMANDS]
    modules += [f"suite.experiments.{name}" for name in EXPERIMENTS]
    configs = [importlib.import_module(name).Config for name in modules]
    for config in [*configs, TrainConfig, QuadrotorConfig, PpoConfig, FitConfig]:
        for cls in _dataclasses(config):
            hints = get_type_hints(cls, include_extras=True)
            without = [name for name in _numbers(cls) if "Range(" not in repr(hints[name])]
            assert not without, cls


def test_a_plain_file_is_read(tmp_path):
    path = tmp_path / "a.json"
    path.write_text('{"a": [1, {"b": null}]}')
    assert read_json(path) == {"a": [1, {"b": None}]}
    path.write_text("a = 1\nb.c = 'é'", encoding="utf-8")
    assert read_toml(path) == {"a": 1, "b": {"c": "é"}}
    with pytest.raises(OSError):
        read_bytes(tmp_path / ("x" * 300))


def test_a_file_that_says_it_is_empty_is_read_to_its_limit():
    if not os.path.exists("/proc/self/maps"):
        pytest.skip("no /proc")
    with pytest.raises(InputError, match="has more bytes"):
        read_bytes("/proc/self/maps", 10)


DEEP = 100_000


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.json", "[" * DEEP + "]" * DEEP, "nested deeper than the 64"),
        ("a.json", "[" * 70 + "]" * 70, "nested deeper"),
        ("a.json", '{"a":' * DEEP + "1" + "}" * DEEP, "nested deeper"),
        ("a.json", "9" * 5000, "not JSON .*4300"),
        ("a.json", '{"a": ', "not JSON"),
        ("a.json", b"\xff\xfe\xfd", "not JSON"),
        ("a.json", "", "not JSON"),
        ("a.toml", "a = " + "[" * DEEP + "]" * DEEP, "nested deeper"),
        ("a.toml", ".".join(["a"] * 2000) + " = 1", "nested deeper"),
        ("a.toml", "a = " + "9" * 5000, "is not TOML: .*4300"),
        ("a.toml", "a = = 1", "is not TOML"),
        ("a.toml", b"a = '\xff'", "is not TOML"),
        ("a.toml", "a\0 = 1", "is not TOML"),
    ],
)
def test_text_of_any_sort_is_read_or_refused(tmp_path, name, text, words):
    path, read = tmp_path / name, read_json if name == "a.json" else read_toml
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=f"{name}: .*{words}"):
        read(path)

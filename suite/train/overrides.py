"""Settings of a run changed by name: `loss.progress=1.2`."""

from __future__ import annotations

import ast
import dataclasses
import math
from collections.abc import Iterable
from typing import TypeVar, get_args, get_type_hints

from tracks.common.names import unknown_name
from tracks.input.ranges import check_ranges, is_finite, shown

T = TypeVar("T")

ABSENT = {
    "quadrotor": "add --model quad and --vehicle, or take a preset that trains through quadrotors",
    "fleet": "add --model fleet",
}
"""Parts that not every run has -> how a run gets one."""


def override(config: T, changes: Iterable[str]) -> T:
    """Return `config` with every change "field.field=value" made, within the fields' ranges.

    Raises:
        ValueError: naming the setting, what is wrong with it and what is allowed.
    """
    for change in changes:
        path, separator, text = change.partition("=")
        if not separator:
            raise ValueError(f"--set {shown(change)}: write FIELD=VALUE, such as loss.progress=0.4")
        config = _changed(config, path.strip().split("."), text.strip(), shown(change))
        check_ranges(config, f"--set {shown(change)}: ")
    return config


def _changed(config: T, path: list[str], text: str, change: str) -> T:
    if not dataclasses.is_dataclass(config) or isinstance(config, type):
        raise ValueError(f"--set {change}: {shown(path[0])} is below a setting that has no parts")
    name, *rest = path
    names = [field.name for field in dataclasses.fields(config)]
    if name not in names:
        raise unknown_name(f"--set {change}: setting", name, names)
    old = getattr(config, name)
    if rest and old is None and name in ABSENT:
        raise ValueError(f"--set {change}: this run has no {name}; {ABSENT[name]}")
    if rest:
        return dataclasses.replace(config, **{name: _changed(old, rest, text, change)})
    if dataclasses.is_dataclass(old):
        parts = ", ".join(field.name for field in dataclasses.fields(old))
        raise ValueError(f"--set {change}: {name!r} has parts, set one of {parts}")
    kinds = get_args(get_type_hints(type(config))[name])
    if type(None) in kinds and text == "None":
        return dataclasses.replace(config, **{name: None})
    if old is None and kinds[0] in (int, float, str):
        old = kinds[0]()
    return dataclasses.replace(config, **{name: _value(old, text, change)})


def _value(old: object, text: str, change: str) -> object:
    try:
        value = ast.literal_eval(text)
    # Nested a thousand times it is none of ours, whichever way the parser gives up.
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        value = text
    if isinstance(old, tuple) and isinstance(value, (tuple, list)) and len(value) == len(old):
        return tuple(_value(a, repr(b), change) for a, b in zip(old, value, strict=True))
    if isinstance(old, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value) if is_finite(value) else math.inf
    if type(value) is not type(old) or isinstance(old, tuple):
        raise ValueError(
            f"--set {change}: {shown(text)} does not fit, the setting is like {old!r} "
            f"({type(old).__name__})"
        )
    return value

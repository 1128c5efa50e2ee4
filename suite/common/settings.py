"""The settings of a configuration as a list: path, default, allowed values and meaning of each."""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import textwrap
from collections.abc import Iterator
from typing import Any, NamedTuple

from tracks.input.ranges import ranged


class Setting(NamedTuple):
    """One setting."""

    path: str
    """As `--set` takes it, such as loss.progress."""
    default: Any
    """Its value in the configuration at hand."""
    allowed: str
    """Its range; "" where its type alone limits it."""
    about: str
    """What it means, with its unit."""


def settings(config: Any) -> Iterator[Setting]:
    """Yield every setting of a dataclass and of the dataclasses within, in their order."""
    allowed = {".".join(path): str(limits) for path, _, limits in ranged(config)}
    yield from _settings(config, "", allowed)


def _settings(config: Any, prefix: str, allowed: dict[str, str]) -> Iterator[Setting]:
    texts = abouts(type(config))
    for field in dataclasses.fields(config):
        path, value = f"{prefix}{field.name}", getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from _settings(value, f"{path}.", allowed)
        else:
            yield Setting(path, value, allowed.get(path, ""), texts.get(field.name, ""))


@functools.cache
def abouts(cls: type) -> dict[str, str]:
    """Return the text under each field of a dataclass, which Python itself does not keep."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
    assert isinstance(body, ast.ClassDef)
    found = {}
    for field, after in zip(body.body, body.body[1:], strict=False):
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
            text = after.value if isinstance(after, ast.Expr) else None
            if isinstance(text, ast.Constant) and isinstance(text.value, str):
                found[field.target.id] = " ".join(text.value.split())
    return found

"""The settings of a configuration, and a command's options, as lists with the meaning of each."""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import textwrap
from collections.abc import Iterator
from typing import Any, NamedTuple, TypeVar, get_type_hints

from tracks.input.ranges import ranged


class Setting(NamedTuple):
    """One setting."""

    path: str
    """As `--set` takes it, such as loss.progress; of a command as it is given, such as --track."""
    default: Any
    """Its value in the configuration at hand; of a command "" where there is none to show."""
    allowed: str
    """Its range; "" where its type alone limits it."""
    about: str
    """What it means, with its unit."""


def settings(config: Any) -> Iterator[Setting]:
    """Yield every setting of a dataclass and of the dataclasses within, in their order."""
    allowed = {".".join(path): str(limits) for path, _, limits in ranged(config)}
    yield from _settings(config, "", allowed)


def _settings(config: Any, prefix: str, allowed: dict[str, str]) -> Iterator[Setting]:
    texts = _abouts(type(config))
    for field in dataclasses.fields(config):
        path, value = f"{prefix}{field.name}", getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from _settings(value, f"{path}.", allowed)
        else:
            yield Setting(path, value, allowed.get(path, ""), texts.get(field.name, ""))


def options(command: type) -> Iterator[Setting]:
    """Yield the options of a command's configuration and of the dataclasses within.

    What is given without an option is a word in capitals.
    """
    import tyro

    hints, texts = get_type_hints(command, include_extras=True), _abouts(command)
    for field in dataclasses.fields(command):
        kind = getattr(hints[field.name], "__origin__", hints[field.name])
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            yield from options(kind)
            continue
        notes = getattr(hints[field.name], "__metadata__", ())
        named = next((n.name for n in notes if getattr(n, "name", None)), field.name)
        # A type variable stands for the subcommands.
        free = tyro.conf.Positional in notes or isinstance(kind, TypeVar)
        plain = isinstance(field.default, str | int | float) and not isinstance(field.default, bool)
        default = str(field.default) if plain else ""
        name = field.name.upper() if free else f"--{named.replace('_', '-')}"
        yield Setting(name, default, "", texts.get(field.name, ""))


@functools.cache
def _abouts(cls: type) -> dict[str, str]:
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

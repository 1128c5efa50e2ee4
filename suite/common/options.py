"""Make command-line options from the fields of a dataclass.

The text below a field is the description of its option. The parser is the package tyro. Rare
options are annotated `Advanced[...]` and are at the end of the help. A nested dataclass only groups
options in the code: its fields are options of the command like all others.
"""

from __future__ import annotations

import ast
import dataclasses
import functools
import inspect
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar, get_args, get_origin, get_type_hints

import tyro

from tracks.input.ranges import ranged

T = TypeVar("T")
"""Type of the value of an option."""
GROUP = "advanced"
"""Title of the group of rare options in the help, and annotation that marks a rare option."""
Advanced = Annotated[T, GROUP]
"""Type of a rare option: `Advanced[int]` is an int in the group of rare options."""
VALUES = {str: "STR", int: "INT", float: "FLOAT", Path: "PATH"}
"""Type -> placeholder of a value in the help."""
NUMBERS = {int: "a whole number", float: "a number"}
"""Type of a number -> its name in messages."""
SILENT = ("", "''", "None", "False")
"""Defaults that the help does not print, because the description of the option says what happens
without it."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Command:
    """The options of all commands; the `Config` class of each command adds further ones."""

    json: bool = False
    """Print one JSON object to standard output and nothing else."""

    LOCKED = ()
    """Names of the options whose folders this command writes; while it runs, no other command may
    write there."""

    def written(self) -> list[Path]:
        """Return the folders of the options in `LOCKED`."""
        return [getattr(self, name) for name in self.LOCKED]

    def refuse_unused(self, names: Iterable[str], reason: str) -> None:
        """Refuse options that have another value than by default, but no effect for a `reason`.

        Raises:
            ValueError: for the first of the fields `names` with such a value.
        """
        for name in names:
            value = getattr(self, name)
            if value != getattr(type(self), name):
                shown = " ".join(value) if isinstance(value, tuple) else value
                raise ValueError(f"--{name} is {shown}, but {reason}; leave it out")


class Option(NamedTuple):
    """One option of a command."""

    field: str
    """Name of the field in the configuration."""
    kind: Any
    """Type of the field, with annotations."""
    default: Any
    """Default of the option; `dataclasses.MISSING` if the option is required."""
    about: str
    """Description of the option, the text below the field."""
    advanced: bool

    @property
    def notes(self) -> tuple[Any, ...]:
        """The annotations of the type."""
        return getattr(self.kind, "__metadata__", ())

    @property
    def bare(self) -> Any:
        """The type without annotations."""
        return _bare(self.kind)

    @property
    def repeated(self) -> bool:
        """Whether the option is written again for each value: `--policy a --policy b`."""
        return tyro.conf.UseAppendAction in self.notes

    @property
    def listed(self) -> bool:
        """Whether the option takes several values (`--speed 0.3 1`), none of them a path."""
        return (
            get_origin(self.bare) is tuple
            and not self.repeated
            and not any(_bare(part) is Path for part in get_args(self.bare))
        )

    @property
    def positional(self) -> bool:
        """Whether the value is written without the option's name."""
        return tyro.conf.Positional in self.notes

    @property
    def flag(self) -> str:
        """The option as it is written, such as --track; a positional one is in capitals."""
        if self.positional:
            return self.field.upper()
        # An annotation may give an option another name than its field.
        name = next((note.name for note in self.notes if getattr(note, "name", None)), self.field)
        return f"--{name.replace('_', '-')}"


def _bare(kind: Any) -> Any:
    return _bare(get_args(kind)[0]) if get_origin(kind) is Annotated else kind


def options(command: type, default: Any = None, advanced: bool = False) -> Iterator[Option]:
    """Yield the options of a command's configuration and of the dataclasses in its fields.

    Inherited options come last. The values of `default` replace those of `command`, a dataclass.
    With `advanced` all options are rare.
    """
    hints, texts = get_type_hints(command, include_extras=True), field_texts(command)
    not_inherited = command.__dict__.get("__annotations__", {})
    fields = sorted(dataclasses.fields(command), key=lambda field: field.name not in not_inherited)
    for field in fields:
        kind = hints[field.name]
        is_rare = advanced or GROUP in getattr(kind, "__metadata__", ())
        value = field.default if default is None else getattr(default, field.name)
        if _is_instance_of_dataclass(value):
            yield from options(type(value), value, is_rare)
        else:
            yield Option(field.name, kind, value, texts.get(field.name, ""), is_rare)


def read_options(
    kind: Any, prog: str, about: str, args: Sequence[str], all_known: bool = False
) -> tuple[Any, list[str]]:
    """Return the configuration from `args`, and the words that belong to no option.

    The help begins with `prog` and `about`. With `all_known`, a word that belongs to no option ends
    the program with a list of similar options.

    Raises:
        SystemExit: after --help (code 0), and for invalid options (code 2).
    """
    registry = tyro.constructors.ConstructorRegistry()
    registry.struct_rule(_command_rule)
    registry.primitive_rule(_number_rule)
    marks = (tyro.conf.FlagCreatePairsOff, tyro.conf.DisallowNone)
    with registry:
        if all_known:
            return tyro.cli(kind, prog=prog, description=about, args=args, config=marks), []
        return tyro.cli(
            kind, prog=prog, description=about, args=args, config=marks, return_unknown_args=True
        )


def _is_instance_of_dataclass(value: Any) -> bool:
    """Return whether `value` is an instance of a dataclass, not a dataclass itself."""
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _command_rule(
    info: tyro.constructors.StructTypeInfo,
) -> tyro.constructors.StructConstructorSpec | None:
    """Return the specification of a configuration for tyro, with rare options in a group.

    tyro calls this for every dataclass; None leaves the class to tyro's own rules, as for the group
    of rare options that is made here.
    """
    command: Any = info.type
    if not hasattr(command, "__dataclass_fields__") or command.__name__ == GROUP:
        return None
    all_options = list(options(command))
    fields = [_tyro_field(option) for option in all_options if not option.advanced]
    rare = [_tyro_field(option) for option in all_options if option.advanced]
    if rare:
        members = list[Any]()
        for spec in rare:
            field = dataclasses.field(default=spec.default, metadata={"help": spec.helptext})
            members.append((spec.name, spec.type, field))
        group = dataclasses.make_dataclass(GROUP, members, namespace={"__doc__": "Seldom needed."})
        kind: Any = tyro.conf.OmitArgPrefixes[group]
        fields.append(tyro.constructors.StructFieldSpec(GROUP, kind, group()))

    def build(**values: Any) -> Any:
        return _build_config(command, {**values, **(vars(values[GROUP]) if rare else {})})

    return tyro.constructors.StructConstructorSpec(build, tuple(fields))


def _number_rule(
    info: tyro.constructors.PrimitiveTypeInfo,
) -> tyro.constructors.PrimitiveConstructorSpec[Any] | None:
    """Return the specification of a number for tyro, with a plain message for other text.

    tyro calls this for every type; None leaves it to tyro's rules. `int | None` is a number too.
    """
    kinds = {_bare(kind) for kind in get_args(info.type) or (info.type,)} - {type(None)}
    kind: Any = kinds.pop() if len(kinds) == 1 else None
    if kind not in NUMBERS or get_origin(info.type) is tuple:
        return None
    expected = NUMBERS[kind]

    def read(words: list[str]) -> Any:
        try:
            return kind(words[0])
        except ValueError:
            raise ValueError(f"{words[0]!r} is not {expected}") from None

    return tyro.constructors.PrimitiveConstructorSpec(
        1, VALUES[kind], read, lambda v: v is None or isinstance(v, kind), lambda v: [str(v)]
    )


def _build_config(command: Any, values: dict[str, Any]) -> Any:
    """Return an instance of `command` and of the dataclasses in it, from `values` by field name."""
    return command(
        **{
            field.name: _build_config(type(field.default), values)
            if _is_instance_of_dataclass(field.default)
            else values[field.name]
            for field in dataclasses.fields(command)
        }
    )


def _tyro_field(option: Option) -> tyro.constructors.StructFieldSpec:
    """Return the specification of an option for tyro, with its placeholder and default."""
    required, metavar = option.default is dataclasses.MISSING, None
    types = get_args(option.bare)
    takes_many = types and get_origin(option.bare) is tuple and types[-1] is Ellipsis
    if option.positional:
        metavar = f"{option.flag} ..." if takes_many else option.flag
        metavar = metavar if required else f"[{metavar}]"
    elif takes_many and not option.repeated:
        metavar = f"{VALUES[_bare(types[0])]} ..."
    display = tyro.conf.arg(
        metavar=metavar,
        help_behavior_hint=lambda default: "" if default in SILENT else f"(default: {default})",
    )
    default = tyro.MISSING if required else option.default
    kind: Any = Annotated[option.kind, display]
    return tyro.constructors.StructFieldSpec(option.field, kind, default, option.about)


class Setting(NamedTuple):
    """One setting of a training."""

    path: str
    """Name of the setting in `--set`, such as loss.progress."""
    default: Any
    """Value of the setting in the listed configuration."""
    allowed: str
    """Allowed range; "" if only the type limits the value."""
    about: str
    """Description of the setting, with its unit."""


def settings(config: Any, prefix: str = "") -> Iterator[Setting]:
    """Yield every setting of a dataclass and of the dataclasses in its fields, in their order.

    Their names begin with `prefix`.
    """
    allowed = {".".join(path): str(limits) for path, _, limits in ranged(config)}
    texts = field_texts(type(config))
    for field in dataclasses.fields(config):
        path, value = f"{prefix}{field.name}", getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from settings(value, f"{path}.")
        else:
            yield Setting(path, value, allowed.get(field.name, ""), texts.get(field.name, ""))


@functools.cache
def field_texts(cls: type) -> dict[str, str]:
    """Return the text below each field of a class and its bases, read from the source code.

    Python does not keep these texts, so the source code is parsed.
    """
    texts = dict[str, str]()
    for base in reversed(cls.__mro__):
        try:
            source = inspect.getsource(base)
        except (OSError, TypeError):
            continue  # a class without source: made at run time, or built into Python
        (definition,) = ast.parse(textwrap.dedent(source)).body
        assert isinstance(definition, ast.ClassDef)
        for field, statement_below in zip(definition.body, definition.body[1:], strict=False):
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                text = statement_below.value if isinstance(statement_below, ast.Expr) else None
                if isinstance(text, ast.Constant) and isinstance(text.value, str):
                    texts[field.target.id] = " ".join(text.value.split())
    return texts

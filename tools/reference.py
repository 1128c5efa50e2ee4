"""Write docs/reference: commands, Python names, settings, effects and sensors, from the code.

Run: python tools/reference.py [--check]; with --check it writes nothing and ends with 1 where a
page is not what the code says.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Iterable
from dataclasses import MISSING, is_dataclass
from pathlib import Path
from typing import Any

import suite
from eval.effects import EFFECTS
from eval.effects.interface import at
from eval.quadrotor.vehicle_file import load_vehicle
from eval.sensors import SENSORS
from suite.common.options import SILENT, Option, options, settings
from suite.common.usage import EXAMPLES, GROUPS
from suite.train.recipes import named_recipe

PAGES = Path(__file__).resolve().parents[1] / "docs" / "reference"
HEAD = "<!-- Made by tools/reference.py; change the code, not this page. -->\n"


def cell(text: Any) -> str:
    """Return a text for a cell of a table."""
    return " ".join(str(text).split()).replace("|", "\\|")


def commands() -> str:
    """Return the page of commands."""
    parts = ["# Commands, option by option\n"]
    for group, table in GROUPS.items():
        parts.append(f"## {group}\n")
        for name, summary in table.items():
            module = importlib.import_module(f"suite.commands.{name}")
            parts.append(f"### suite {name}\n\n{summary[0].upper()}{summary[1:]}.\n")
            parts.append("```sh\n" + "\n".join(EXAMPLES[name]) + "\n```\n")
            found = [one for one in options(module.Config) if one.flag != "--json"]
            rows = [
                f"| `{one.flag}` | {_default(one)} | {cell(one.about)} |"
                for one in sorted(found, key=lambda one: one.advanced)
            ]
            if rows:
                parts.append("\n".join(["| option | default | meaning |", "|---|---|---|", *rows]))
                parts.append("")
    return "\n".join(parts)


def _default(option: Option) -> str:
    """Return an option's default as a cell; empty where the text says what happens without it."""
    value = option.default
    if value is MISSING:
        return "required"
    text = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return "" if text in SILENT else cell(text)


def python() -> str:
    """Return the page of the Python interface."""
    parts = [f"# Python\n\n{inspect.getdoc(suite)}\n"]
    for name in suite.__all__:
        function = getattr(suite, name)
        parts.append(f"## {name}\n\n```text\nsuite.{name}{inspect.signature(function)}\n```\n")
        parts.append(f"```text\n{inspect.getdoc(function)}\n```\n")
    return "\n".join(parts)


def _value(value: Any) -> str:
    """Return a setting's value as a cell; the phases of a recipe are counted."""
    counted = isinstance(value, tuple) and value and is_dataclass(value[0])
    return f"{len(value)} of them" if counted else cell(value)


def training() -> str:
    """Return the page of the settings of a training."""
    rows = [
        f"| `{one.path}` | {_value(one.default)} | {one.allowed} | {cell(one.about)} |"
        for one in settings(named_recipe("race"))
        if not one.path.startswith("quadrotor.vehicle.")
    ]
    head = "| setting | in `race`, first phase | allowed | meaning |\n|---|---|---|---|\n"
    return (
        "# Settings of a training\n\nWhat `suite train --set` takes.\n\n" + head + "\n".join(rows)
    )


def catalogue(title: str, entries: Iterable[Any]) -> str:
    """Return the page of a catalogue: effects of a vehicle file, or sensor models."""
    vehicle, rows = load_vehicle("reference"), list[str]()
    for entry in entries:
        about = f"`{entry.name}` | {cell(entry.summary)} | {cell(entry.equation)}"
        for parameter in entry.parameters:
            low, high = (at(end, vehicle) for end in (parameter.low, parameter.high))
            usual = " to ".join(f"{end:g}" for end in parameter.typical)
            rows.append(
                f"| {about} | `{parameter.name}` [{parameter.unit}] | {usual} | "
                f"{low:g} to {high:g} |"
            )
            about = " | | "
    head = (
        "| name | what | equation | parameter | usual size | allowed |\n|---|---|---|---|---|---|\n"
    )
    return f"# {title}\n\n{head}" + "\n".join(rows)


MADE = {
    "commands": commands,
    "python": python,
    "settings": training,
    "effects": lambda: catalogue("Effects of a vehicle file", EFFECTS.values()),
    "sensors": lambda: catalogue("Models of a sensors file", SENSORS.values()),
}
"""Page -> what returns its text."""


def main(check: bool) -> int:
    """Write the pages, or compare them with what would be written."""
    stale = 0
    for name, make in MADE.items():
        path, text = PAGES / f"{name}.md", f"{HEAD}{make().rstrip()}\n"
        if path.is_file() and path.read_text(encoding="utf-8") == text:
            continue
        stale += 1
        if check:
            print(f"{path}: not what the code says; run python tools/reference.py")
        else:
            path.parent.mkdir(exist_ok=True)
            path.write_text(text, encoding="utf-8")
    return int(check and stale > 0)


if __name__ == "__main__":
    raise SystemExit(main("--check" in sys.argv[1:]))

"""Generate docs/reference from the code: commands, Python names, settings, catalogues.

    python tools/reference.py [--check]

With --check it writes nothing, and the exit code is 1 if a page differs from the generated one.
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from collections.abc import Iterable
from dataclasses import MISSING
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this checkout, not an installed one
import suite
from eval.effects import EFFECTS
from eval.effects.interface import bound_value
from eval.logs.faults.catalogue import FAULTS
from eval.quadrotor.vehicle_file import load_vehicle
from eval.sensors import SENSORS
from eval.sensors.measured_state import Axis, MeasuredState
from suite.commands.list import settings_to_change
from suite.common.options import SILENT, Option, field_texts, options
from suite.common.usage import EXAMPLES, GROUPS
from suite.train.recipes import named_recipe, with_sensors

HEADS = Path(__file__).with_name("heads")
"""Folder of the text above the generated part of each page."""
PAGES = Path(__file__).resolve().parents[1] / "docs" / "reference"
"""Folder of the generated pages."""
HEAD = "<!-- Made by tools/reference.py; change the code, not this page. -->\n"
"""First line of each page."""
WITHOUT_AXIS = {
    "velocity_scale": "k: relative error of the velocity.",
    "position_drift": "c: drift of the position over the root of the distance.",
}
"""Parameter of the sensor model `measured_state` that has no axis -> its meaning."""
SETTING_GROUPS = {
    "spec": "The policy: rate, camera, inputs, network (`spec`)",
    "physics": "The point mass, and the images of all trainings (`physics`)",
    "quadrotor": "The quadrotor and how it varies between worlds (`quadrotor`)",
    "loss": "The loss and the field (`loss`)",
    "episode": "The worlds of a gradient step (`episode`)",
    "optimizer": "The optimiser (`optimizer`)",
    "sensors": "Sensor errors, with `--sensors` (`sensors`)",
}
"""First part of a setting's name -> heading of its table."""


def head(page: str) -> str:
    """Return the title and the introduction of a page."""
    return (HEADS / f"{page}.md").read_text(encoding="utf-8")


def cell(text: Any) -> str:
    """Return a text in one line, with escaped bars, for a cell of a table."""
    return " ".join(str(text).split()).replace("|", "\\|")


def commands() -> str:
    """Return the page of commands."""
    parts = [head("commands")]
    for group, table in GROUPS.items():
        parts.append(f"## {group}\n")
        for name, summary in table.items():
            module = importlib.import_module(f"suite.commands.{name}")
            parts.append(f"### suite {name}\n\n{summary[0].upper()}{summary[1:]}.\n")
            parts.append("```sh\n" + "\n".join(EXAMPLES[name]) + "\n```\n")
            listed = [option for option in options(module.Config) if option.flag != "--json"]
            rows = [
                f"| `{option.flag}` | {_default(option)} | {cell(option.about)} |"
                for option in sorted(listed, key=lambda option: option.advanced)
            ]
            if rows:
                parts.append("\n".join(["| option | default | meaning |", "|---|---|---|", *rows]))
                parts.append("")
    return "\n".join(parts)


def _default(option: Option) -> str:
    """Return the default of an option as the text of a cell.

    It is empty if the description says what happens without the option.
    """
    value = option.default
    if value is MISSING:
        return "required"
    text = " ".join(map(str, value)) if isinstance(value, tuple) else str(value)
    return "" if text in SILENT else cell(text)


class _Plain(str):
    """An annotation that a signature prints without quotes."""

    __repr__ = str.__str__


def _signature(function: Any) -> str:
    """Return the signature of a function, with one parameter in a line."""
    signature = inspect.signature(function)
    parameters = [
        parameter.replace(annotation=_Plain(parameter.annotation))
        for parameter in signature.parameters.values()
    ]
    # A bare `*` precedes the keyword-only parameters.
    lines = [str(parameter) for parameter in parameters]
    is_keyword_only = [p.kind is inspect.Parameter.KEYWORD_ONLY for p in parameters]
    if True in is_keyword_only:
        lines.insert(is_keyword_only.index(True), "*")
    body = "\n".join(f"    {line}," for line in lines)
    return f"suite.{function.__name__}(\n{body}\n) -> {signature.return_annotation}"


def python() -> str:
    """Return the page of the Python interface."""
    parts = [head("python")]
    for name in suite.__all__:
        function = getattr(suite, name)
        parts.append(f"## {name}\n\n```text\n{_signature(function)}\n```\n")
        parts.append(f"```text\n{inspect.getdoc(function)}\n```\n")
    return "\n".join(parts)


def training() -> str:
    """Return the page of the settings of a training: a table for each group of settings."""
    groups = dict[str, list[str]]()
    for setting in settings_to_change(with_sensors(named_recipe("race"), "vio")):
        default, about = cell(setting.default), cell(setting.about)
        row = f"| `{setting.path}` | {default} | {setting.allowed} | {about} |"
        groups.setdefault(setting.path.split(".")[0], []).append(row)
    titles = "| setting | in `race`, first phase | allowed | meaning |\n|---|---|---|---|\n"
    parts = [head("settings")]
    for group, title in SETTING_GROUPS.items():
        parts.append(f"## {title}\n\n{titles}" + "\n".join(groups.pop(group)) + "\n")
    assert not groups, f"settings without a title: {sorted(groups)}"
    return "\n".join(parts)


def _meaning(entry: Any, parameter: str) -> str:
    """Return the text below the field of a parameter, without its shape and unit."""
    # `measured_state` makes its parameters from those of one axis: pos_x_noise -> noise.
    if entry.values is MeasuredState:
        suffix = re.sub(r"^[a-z]+_[xyz]_?", "", parameter)
        text = WITHOUT_AXIS.get(parameter) or field_texts(Axis)[suffix or "noise"]
    else:
        text = field_texts(entry.values)[parameter]
    text = re.sub(r"^\([^)]*\),? ?| \[[^]]*\](?=[.;]|$)", "", text)
    return text if re.match(r"\w+:", text) else text[:1].upper() + text[1:]


def catalogue(page: str, entries: Iterable[Any]) -> str:
    """Return the page of a catalogue: effects of a vehicle file, or sensor models."""
    vehicle, parts = load_vehicle("reference"), [head(page)]
    for entry in entries:
        equation = entry.equation.replace("; ", "\n    ")
        stage = f" Table `[[{entry.stage}]]`." if hasattr(entry, "stage") else ""
        parts.append(f"## {entry.name}\n\n{entry.summary}.{stage}\n\n    {equation}\n")
        rows = dict[str, str]()
        for parameter in entry.parameters:
            low, high = (bound_value(end, vehicle) for end in (parameter.low, parameter.high))
            usual = " to ".join(f"{end:g}" for end in parameter.typical)
            about = cell(_meaning(entry, parameter.name))
            # The nine axes of `measured_state` differ in their names only.
            name = re.sub(r"_[xyz](?=_|$)", "_AXIS", parameter.name)
            shown = f"`{name}` [{parameter.unit}]"
            shown += f", list of {parameter.size}" if getattr(parameter, "size", 0) else ""
            default = f"{bound_value(parameter.neutral, vehicle):g}"
            default = "required" if getattr(parameter, "required", False) else default
            cells = (shown, about, usual, f"{low:g} to {high:g}", default)
            rows[name] = f"| {' | '.join(cells)} |"
        heads = "| parameter | meaning | usual size | allowed | if left out |"
        parts.append(f"{heads}\n|---|---|---|---|---|")
        parts.append("\n".join(rows.values()) + f"\n\nSource: {entry.source}.\n")
    return "\n".join(parts)


def faults() -> str:
    """Return the page of the faults of a log."""
    rows = [f"| `{name}` | {about} | {manoeuvre} |" for name, (about, manoeuvre) in FAULTS.items()]
    return "\n".join([head("faults"), "| fault | meaning | manoeuvre |\n|---|---|---|", *rows, ""])


GENERATORS = {
    "commands": commands,
    "python": python,
    "settings": training,
    "effects": lambda: catalogue("effects", EFFECTS.values()),
    "sensors": lambda: catalogue("sensors", SENSORS.values()),
    "faults": faults,
}
"""Name of a page -> function that returns its text."""


def main(check: bool) -> int:
    """Write the pages, or with `check` compare them with the generated text.

    Return the exit code: 1 if `check` finds a page that differs.
    """
    stale = 0
    for name, make in GENERATORS.items():
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

"""The command `suite list`: print the names that other commands accept, such as all tracks."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import tyro

from suite.commands.tracks import family_text
from suite.common.console import Console
from suite.common.options import Command, Setting, settings
from suite.common.usage import first_paragraph
from tracks.common.names import unknown_name

if TYPE_CHECKING:
    from suite.train.config import TrainConfig


@dataclass(frozen=True)
class Config(Command):
    """List the names that other commands accept.

    Kinds: tracks, vehicles, policies, recipes, effects, sensors (files), sensor-models, simulators,
    benchmarks, settings (of suite train --set).
    """

    kind: tyro.conf.Positional[str] = ""
    """The kind of names. Without it the names of all kinds but the settings."""
    recipe: str = "race"
    """For the kind settings: the recipe whose settings are listed."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """List the names of a kind with a line about each, or the names of all kinds."""
    if config.kind == "settings":
        from suite.train.recipes import named_recipe

        return {"settings": list_settings(named_recipe(config.recipe), console)}
    config.refuse_unused(("recipe",), "only `suite list settings` takes it")
    if not config.kind:
        all_names = {kind: sorted(_entries(kind)) for kind in KINDS}
        width = max(map(len, all_names))
        for kind_name, names in all_names.items():
            console.say(f"{kind_name:<{width}}  {', '.join(names)}")
        console.say("suite list KIND has a line about each; suite list settings: of suite train")
        return all_names
    if config.kind not in KINDS:
        raise unknown_name("kind", config.kind, [*KINDS, "settings"])
    descriptions = {name: _line(config.kind, name) for name in _entries(config.kind)}
    width = max(map(len, descriptions))
    for name, text in descriptions.items():
        console.say(f"{name:<{width}}  {text}")
    return {config.kind: descriptions}


def settings_to_change(config: TrainConfig) -> list[Setting]:
    """Return all settings that `--set` changes in `config`, with their values before the phases."""
    from suite.train.overrides import ABSENT, FROM_FILES, is_within

    fixed = ("phases", "seed", *ABSENT)
    return [
        one
        for one in settings(config)
        if one.path not in fixed and not any(is_within(one.path, part) for part in FROM_FILES)
    ]


def list_settings(config: TrainConfig, console: Console) -> list[dict[str, Any]]:
    """Print every setting of a training with its value, range and meaning, and return them.

    The values are those before the phases.
    """
    all_settings = settings_to_change(config)
    for setting in all_settings:
        allowed = f", allowed {setting.allowed}" if setting.allowed else ""
        console.say(f"{setting.path} = {setting.default!r}{allowed}\n    {setting.about}")
    return [setting._asdict() for setting in all_settings]


def _entries(kind: str) -> Any:
    """Return the table of the entries of a kind, or the list of their names."""
    module, attribute, _ = KINDS[kind]
    found = getattr(importlib.import_module(module), attribute)
    return found() if callable(found) else found


def _line(kind: str, name: str) -> str:
    """Return a line about an entry of a kind."""
    if describe := KINDS[kind][2]:
        return describe(name)
    entry = _entries(kind)[name]
    if isinstance(entry, str):
        return entry
    text = getattr(entry, "summary", "") or first_paragraph(entry.__doc__).removeprefix("Return ")
    return f"{text[:1].upper()}{text[1:]}"


def _vehicle(name: str) -> str:
    """Return a line about a shipped vehicle."""
    from eval.quadrotor.vehicle_file import load_vehicle

    vehicle = load_vehicle(name)
    effects = ", ".join(vehicle.effects) or "no effects"
    return f"{vehicle.mass:g} kg, controller {vehicle.controller.kind}; {effects}"


def _policy(name: str) -> str:
    """Return a line about a shipped policy."""
    from policies.policy import load_policy

    spec = load_policy(name).spec
    return f"{spec.action.kind}, {spec.rate_hz:g} Hz, {spec.state_size} state inputs and depth"


def _sensors(name: str) -> str:
    """Return the sensor models of a shipped sensors file."""
    from eval.sensors.sensors_file import load_sensors

    return ", ".join(load_sensors(name).models) or "no errors"


KINDS: dict[str, tuple[str, str, Callable[[str], str] | None]] = {
    "tracks": ("tracks.families", "FAMILIES", family_text),
    "vehicles": ("eval.quadrotor.vehicle_file", "shipped_vehicles", _vehicle),
    "policies": ("policies.shipped", "names", _policy),
    "recipes": ("suite.train.recipes", "RECIPES", None),
    "effects": ("eval.effects", "EFFECTS", None),
    "sensors": ("eval.sensors.sensors_file", "shipped_sensors", _sensors),
    "sensor-models": ("eval.sensors", "SENSORS", None),
    "simulators": ("eval.worlds", "WORLDS", None),
    "benchmarks": ("suite.experiments.bench", "BENCHES", None),
}
"""Kind -> module, its table (or function) of the names, and a function (name) -> a line about it.
Without this function the line is the entry's summary. A module is imported when its names are
listed."""

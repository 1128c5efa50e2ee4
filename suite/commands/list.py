"""The command `suite list`: print the names that other commands accept, such as all tracks."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import tyro

from suite.commands.tracks import family_text
from suite.common.console import Console
from suite.common.options import Command
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
    """List the names of a kind with a line about each, or the names of all kinds.

    Raises:
        ValueError: for an unknown kind or recipe.
    """
    if config.kind == "settings":
        recipe = _module("suite.train.recipes").named_recipe(config.recipe)
        return {"settings": list_settings(recipe, console)}
    if not config.kind:
        all_names = {name: sorted(kind.names()) for name, kind in KINDS.items()}
        width = max(map(len, all_names))
        for kind_name, names in all_names.items():
            console.say(f"{kind_name:<{width}}  {', '.join(names)}")
        console.say("suite list KIND has a line about each; suite list settings: of suite train")
        return all_names
    if config.kind not in KINDS:
        raise unknown_name("kind", config.kind, [*KINDS, "settings"])
    kind = KINDS[config.kind]
    descriptions = {name: kind.describe(name) for name in kind.names()}
    width = max(map(len, descriptions))
    for name, text in descriptions.items():
        console.say(f"{name:<{width}}  {text}")
    return {config.kind: descriptions}


def list_settings(config: TrainConfig, console: Console) -> list[dict[str, Any]]:
    """Print every setting of a training with its value, range and meaning, and return them.

    The values are those before the phases.
    """
    from suite.common.options import settings

    all_settings = [setting for setting in settings(config) if setting.path != "phases"]
    for setting in all_settings:
        allowed = f", allowed {setting.allowed}" if setting.allowed else ""
        console.say(f"{setting.path} = {setting.default!r}{allowed}\n    {setting.about}")
    return [setting._asdict() for setting in all_settings]


class Kind(NamedTuple):
    """A kind of names. Packages that only the descriptions need are not loaded for the names."""

    names: Callable[[], Iterable[str]]
    """Function that returns all names."""
    describe: Callable[[str], str]
    """Function that returns a line about a name."""


def _module(name: str) -> Any:
    """Return a module, imported at the first list that needs it."""
    return importlib.import_module(name)


def _vehicle(name: str) -> str:
    """Return a line about a shipped vehicle."""
    vehicle = _module("eval.quadrotor.vehicle_file").load_vehicle(name)
    effects = ", ".join(vehicle.effects) or "no effects"
    return f"{vehicle.mass:g} kg, controller {vehicle.controller.kind}; {effects}"


def _policy(name: str) -> str:
    """Return a line about a shipped policy."""
    spec = _module("policies.policy").load_policy(name).spec
    return f"{spec.action.kind}, {spec.rate_hz:g} Hz, {spec.state_size} state inputs and depth"


def _recipe(name: str) -> str:
    """Return a line about a recipe of `suite train`."""
    return first_paragraph(_module("suite.train.recipes").RECIPES[name].__doc__)


def _sensors(name: str) -> str:
    """Return the sensor models of a shipped sensors file."""
    return ", ".join(_module("eval.sensors.sensors_file").load_sensors(name).models) or "no errors"


def _simulator(name: str) -> str:
    """Return a line about a simulator."""
    return first_paragraph(_module("eval.worlds").WORLDS.find(name).__doc__)


KINDS: dict[str, Kind] = {
    "tracks": Kind(lambda: _module("tracks.families").FAMILIES, family_text),
    "vehicles": Kind(lambda: _module("eval.quadrotor.vehicle_file").shipped_vehicles(), _vehicle),
    "policies": Kind(lambda: _module("policies.shipped").names(), _policy),
    "recipes": Kind(lambda: _module("suite.train.recipes").RECIPES, _recipe),
    "effects": Kind(
        lambda: _module("eval.effects").EFFECTS,
        lambda name: _module("eval.effects").EFFECTS[name].summary,
    ),
    "sensors": Kind(lambda: _module("eval.sensors.sensors_file").shipped_sensors(), _sensors),
    "sensor-models": Kind(
        lambda: _module("eval.sensors").SENSORS,
        lambda name: _module("eval.sensors").SENSORS[name].summary,
    ),
    "simulators": Kind(lambda: _module("eval.worlds").WORLDS, _simulator),
    "benchmarks": Kind(
        lambda: _module("suite.experiments.bench").BENCHES,
        lambda name: _module("suite.experiments.bench").BENCHES[name],
    ),
}
"""Name of each kind -> its names and their descriptions."""

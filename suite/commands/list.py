"""`suite list`: what can be named in other commands, by kind."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import tyro

from suite.commands.tracks import family_text
from suite.common.console import Console
from suite.common.options import Command
from suite.common.usage import first_paragraph
from tracks.common.names import unknown_name


@dataclass(frozen=True)
class Config(Command):
    """List what other commands take by name.

    Kinds: tracks, vehicles, policies, recipes, effects, sensors (files), sensor-models, simulators,
    benchmarks, settings (of suite train --set).
    """

    kind: tyro.conf.Positional[str] = ""
    """Which kind. Without it the names of all kinds but the settings."""
    recipe: str = "race"
    """For the kind settings: of which recipe."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """List a kind with a line about each, or the names of all kinds.

    Raises:
        ValueError: for an unknown kind or recipe.
    """
    if config.kind == "settings":
        return {"settings": list_settings(config.recipe, console)}
    if not config.kind:
        found = {kind: sorted(of.names()) for kind, of in KINDS.items()}
        width = max(map(len, found))
        for kind, names in found.items():
            console.say(f"{kind:<{width}}  {', '.join(names)}")
        console.say("suite list KIND has a line about each; suite list settings: of suite train")
        return found
    if config.kind not in KINDS:
        raise unknown_name("kind", config.kind, [*KINDS, "settings"])
    of = KINDS[config.kind]
    abouts = {name: of.about(name) for name in of.names()}
    width = max(map(len, abouts))
    for name, about in abouts.items():
        console.say(f"{name:<{width}}  {about}")
    return {config.kind: abouts}


def list_settings(recipe: str, console: Console) -> list[dict[str, Any]]:
    """Print every setting of a recipe with its value, range and meaning, and return them."""
    from suite.common.options import settings
    from suite.train.recipes import named_recipe

    found = list(settings(named_recipe(recipe)))
    for one in found:
        allowed = f", allowed {one.allowed}" if one.allowed else ""
        console.say(f"{one.path} = {one.default!r}{allowed}\n    {one.about}")
    return [one._asdict() for one in found]


class Kind(NamedTuple):
    """Entries of one kind; what only an entry's text needs is loaded when that text is printed."""

    names: Callable[[], Iterable[str]]
    about: Callable[[str], str]


def _of(module: str) -> Any:
    """Return a module, imported at the first list that needs it."""
    return importlib.import_module(module)


def _vehicle(name: str) -> str:
    vehicle = _of("eval.quadrotor.vehicle_file").load_vehicle(name)
    effects = ", ".join(vehicle.effects) or "no effects"
    return f"{vehicle.mass:g} kg, controller {vehicle.controller.kind}; {effects}"


def _policy(name: str) -> str:
    spec = _of("policies.policy").load_policy(name).spec
    return f"{spec.action.kind}, {spec.rate_hz:g} Hz, {spec.state_size} state inputs and depth"


def _recipe(name: str) -> str:
    return first_paragraph(_of("suite.train.recipes").RECIPES[name].__doc__)


def _sensors(name: str) -> str:
    return ", ".join(_of("eval.sensors.sensors_file").load_sensors(name).models) or "the truth"


def _simulator(name: str) -> str:
    return first_paragraph(_of("eval.worlds").WORLDS.find(name).__doc__)


KINDS: dict[str, Kind] = {
    "tracks": Kind(lambda: _of("tracks.families").FAMILIES, family_text),
    "vehicles": Kind(lambda: _of("eval.quadrotor.vehicle_file").shipped_vehicles(), _vehicle),
    "policies": Kind(lambda: _of("policies.shipped").names(), _policy),
    "recipes": Kind(lambda: _of("suite.train.recipes").RECIPES, _recipe),
    "effects": Kind(
        lambda: _of("eval.effects").EFFECTS, lambda name: _of("eval.effects").EFFECTS[name].summary
    ),
    "sensors": Kind(lambda: _of("eval.sensors.sensors_file").shipped_sensors(), _sensors),
    "sensor-models": Kind(
        lambda: _of("eval.sensors").SENSORS, lambda name: _of("eval.sensors").SENSORS[name].summary
    ),
    "simulators": Kind(lambda: _of("eval.worlds").WORLDS, _simulator),
    "benchmarks": Kind(
        lambda: _of("suite.experiments.bench").BENCHES,
        lambda name: _of("suite.experiments.bench").BENCHES[name],
    ),
}
"""What can be listed."""

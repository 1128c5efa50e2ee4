"""`suite list`: what can be named in other commands, by kind."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import tyro

from suite.commands.tracks import family_text
from suite.common.console import Console
from suite.common.usage import first_paragraph
from tracks.common.names import unknown_name


@dataclass(frozen=True)
class Config:
    """List what other commands take by name.

    Kinds: tracks, vehicles, policies, recipes, effects, sensors (files), sensor-models, simulators,
    benchmarks, settings (of suite train --set).
    """

    kind: tyro.conf.Positional[str] = ""
    """Which kind; without it, all but the settings, by their names."""
    recipe: str = "race"
    """The recipe whose settings are listed."""
    json: bool = False
    """Print one JSON object to standard output and nothing else."""


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
    from suite.common.settings import settings
    from suite.train.recipes import named_recipe

    found = list(settings(named_recipe(recipe)))
    for one in found:
        allowed = f", allowed {one.allowed}" if one.allowed else ""
        console.say(f"{one.path} = {one.default!r}{allowed}\n    {one.about}")
    return [one._asdict() for one in found]


class Kind(NamedTuple):
    """Things of one kind; what only the line about one needs is loaded when it is asked for."""

    names: Callable[[], Iterable[str]]
    about: Callable[[str], str]


def _tracks() -> Iterable[str]:
    from tracks.families import FAMILIES

    return FAMILIES


def _vehicles() -> Iterable[str]:
    from eval.quadrotor.vehicle_file import shipped_vehicles

    return shipped_vehicles()


def _vehicle(name: str) -> str:
    from eval.quadrotor.vehicle_file import load_vehicle

    vehicle = load_vehicle(name)
    effects = ", ".join(vehicle.effects) or "no effects"
    return f"{vehicle.mass:g} kg, controller {vehicle.controller.kind}; {effects}"


def _policies() -> Iterable[str]:
    from policies.shipped import names

    return names()


def _policy(name: str) -> str:
    from policies.policy import load_policy

    spec = load_policy(name).spec
    return f"{spec.action.kind}, {spec.rate_hz:g} Hz, {spec.state_size} state inputs and depth"


def _recipes() -> Mapping[str, Any]:
    from suite.train.recipes import RECIPES

    return RECIPES


def _effects() -> Mapping[str, Any]:
    from eval.effects import EFFECTS

    return EFFECTS


def _sensors() -> Iterable[str]:
    from eval.sensors.sensors_file import shipped_sensors

    return shipped_sensors()


def _sensor(name: str) -> str:
    from eval.sensors.sensors_file import load_sensors

    return ", ".join(load_sensors(name).models) or "the truth"


def _sensor_models() -> Mapping[str, Any]:
    from eval.sensors import SENSORS

    return SENSORS


def _simulators() -> Iterable[str]:
    from eval.worlds import WORLDS

    return WORLDS


def _simulator(name: str) -> str:
    from eval.worlds import WORLDS

    return first_paragraph(WORLDS.find(name).__doc__)


def _benchmarks() -> Mapping[str, str]:
    from suite.experiments.bench import BENCHES

    return BENCHES


KINDS: dict[str, Kind] = {
    "tracks": Kind(_tracks, family_text),
    "vehicles": Kind(_vehicles, _vehicle),
    "policies": Kind(_policies, _policy),
    "recipes": Kind(_recipes, lambda name: first_paragraph(_recipes()[name].__doc__)),
    "effects": Kind(_effects, lambda name: _effects()[name].summary),
    "sensors": Kind(_sensors, _sensor),
    "sensor-models": Kind(_sensor_models, lambda name: _sensor_models()[name].summary),
    "simulators": Kind(_simulators, _simulator),
    "benchmarks": Kind(_benchmarks, lambda name: _benchmarks()[name]),
}
"""What can be listed."""

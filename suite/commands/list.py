"""`suite list`: what can be named in other commands, by kind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import tyro

from suite.common.console import Console
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
        found = {kind: sorted(about()) for kind, about in KINDS.items()}
        width = max(map(len, found))
        for kind, names in found.items():
            console.say(f"{kind:<{width}}  {', '.join(names)}")
        console.say("suite list KIND has a line about each; suite list settings: of suite train")
        return found
    if config.kind not in KINDS:
        raise unknown_name("kind", config.kind, [*KINDS, "settings"])
    abouts = KINDS[config.kind]()
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


def _first_line(text: str | None) -> str:
    return " ".join((text or "").split("\n\n")[0].split())


def _tracks() -> dict[str, str]:
    from suite.commands.tracks import family_texts

    return family_texts()


def _vehicles() -> dict[str, str]:
    from eval.quadrotor.vehicle_file import load_vehicle, shipped_vehicles

    def about(name: str) -> str:
        vehicle = load_vehicle(name)
        effects = ", ".join(vehicle.effects) or "no effects"
        return f"{vehicle.mass:g} kg, controller {vehicle.controller.kind}; {effects}"

    return {name: about(name) for name in shipped_vehicles()}


def _policies() -> dict[str, str]:
    from policies.policy import load_policy
    from policies.shipped import names

    def about(name: str) -> str:
        spec = load_policy(name).spec
        return f"{spec.action.kind}, {spec.rate_hz:g} Hz, {spec.state_size} state inputs and depth"

    return {name: about(name) for name in names()}


def _recipes() -> dict[str, str]:
    from suite.train.recipes import RECIPES

    return {name: _first_line(make.__doc__) for name, make in RECIPES.items()}


def _effects() -> dict[str, str]:
    from eval.effects import EFFECTS

    return {effect.name: effect.summary for effect in EFFECTS.values()}


def _sensors() -> dict[str, str]:
    from eval.sensors.sensors_file import load_sensors, shipped_sensors

    def about(name: str) -> str:
        return ", ".join(load_sensors(name).models) or "the truth"

    return {name: about(name) for name in shipped_sensors()}


def _sensor_models() -> dict[str, str]:
    from eval.sensors import SENSORS

    return {sensor.name: sensor.summary for sensor in SENSORS.values()}


def _simulators() -> dict[str, str]:
    from eval.worlds import WORLDS

    return {name: _first_line(WORLDS.find(name).__doc__) for name in WORLDS}


def _benchmarks() -> dict[str, str]:
    from suite.experiments.bench import BENCHES

    return dict(BENCHES)


KINDS: dict[str, Callable[[], dict[str, str]]] = {
    "tracks": _tracks,
    "vehicles": _vehicles,
    "policies": _policies,
    "recipes": _recipes,
    "effects": _effects,
    "sensors": _sensors,
    "sensor-models": _sensor_models,
    "simulators": _simulators,
    "benchmarks": _benchmarks,
}
"""Kind -> function that returns the names with a line about each."""

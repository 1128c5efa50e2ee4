"""The command `suite effects`: list the catalogue of physical effects, or describe one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import tyro

from suite.common.console import Console
from suite.common.options import Command

if TYPE_CHECKING:
    from eval.effects.interface import Effect


@dataclass(frozen=True)
class Config(Command):
    """List the physical effects that a vehicle file may hold, or describe one."""

    name: tyro.conf.Positional[str] = ""
    """Name of an effect. Without it all are listed."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """List the catalogue, or describe `config.name`."""
    from eval.effects import EFFECTS
    from eval.effects.interface import bound_value
    from eval.quadrotor.vehicle_file import load_vehicle

    if not config.name:
        width = max(map(len, EFFECTS))
        for effect in EFFECTS.values():
            console.say(f"{effect.name:<{width}}  {effect.summary}")
        return {"effects": {name: _facts(effect) for name, effect in EFFECTS.items()}}
    effect = EFFECTS.find(config.name)
    console.say(f"{effect.name}: {effect.summary}")
    console.say(f"  {effect.equation}")
    console.say(f"  source: {effect.source}")
    vehicle = load_vehicle("reference")
    for parameter in effect.parameters:
        count = f" x {parameter.size}" if parameter.size else ""
        low, high = parameter.typical
        neutral = bound_value(parameter.neutral, vehicle)
        # With `whole` the usual range is one of values, else of differences from neutral.
        reference = f" away from {neutral:g}" if neutral and not parameter.whole else ""
        depends_on_vehicle = any(map(callable, (parameter.low, parameter.high, parameter.neutral)))
        condition = f" (for vehicle {vehicle.name})" if depends_on_vehicle else ""
        optional = "" if parameter.required else "; optional"
        least, most = bound_value(parameter.low, vehicle), bound_value(parameter.high, vehicle)
        console.say(
            f"  {parameter.name}{count} [{parameter.unit}]: usually {low:g} to {high:g}"
            f"{reference}; allowed {least:g} to {most:g}{condition}{optional}"
        )
    return {"effects": {effect.name: _facts(effect)}}


def _facts(effect: Effect) -> dict[str, Any]:
    """Return the description of an effect for --json; limits that vary by vehicle are None."""
    return {
        "summary": effect.summary,
        "equation": effect.equation,
        "source": effect.source,
        "parameters": {
            p.name: {
                "unit": p.unit,
                "components": p.size or 1,
                "typical": p.typical,
                "typical_is": "a value" if p.whole else "a difference from neutral",
                "low": None if callable(p.low) else p.low,
                "high": None if callable(p.high) else p.high,
                "required": p.required,
            }
            for p in effect.parameters
        },
    }

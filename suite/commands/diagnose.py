"""`suite diagnose`: which physical effect is missing from a vehicle, by its flights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from suite.console import Console


@dataclass(frozen=True)
class Config:
    """Find where flights and a vehicle file disagree, and name the missing effect."""

    flights: tyro.conf.Positional[tuple[Path, ...]]
    """Flight logs, or folders of them."""
    vehicle: str
    """The vehicle file that the simulation used, or a shipped vehicle's name."""
    out: Path = Path("runs/diagnosis")
    """Folder for diagnosis.json, vehicle.toml and report.html."""
    drive: Literal["auto", "commands", "motors"] = "auto"
    """What drives the model: logged commands, measured rotor speeds, or what the logs allow."""
    json: bool = False
    """Print one JSON object to standard output and nothing else."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Diagnose, and say what was found.

    Raises:
        ValueError: for flights or a vehicle file that cannot be used.
    """
    from suite.diagnose.run import diagnose_files

    result = diagnose_files(config.flights, config.vehicle, config.drive, config.out, console)
    console.say(f"verdict: {result['verdict']}")
    for effect in result["effects"]:
        rivals = ", ".join(effect["alternatives"])
        same = f" (these flights cannot tell it from {rivals})" if rivals else ""
        console.say(f"  {effect['name']}{same}")
        for name, entry in effect["parameters"].items():
            console.say(f"    {name} = {entry['value']} {entry['unit']}, 95 %: {entry['ci95']}")
    gap = result["gap"]
    console.say(f"gap on held-out flight: {gap['before']:.2f} before, {gap['after']:.2f} after; "
                "1 is the noise floor")  # fmt: skip
    for line in result["separate_with"]:
        console.say(f"would tell {line}")
    console.say(f"report: {config.out / 'report.html'}")
    return result

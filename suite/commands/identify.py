"""`suite identify`: the numbers of a vehicle file from flights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from suite.common.console import Console
from tracks.common.files import check_no_input


@dataclass(frozen=True)
class Config:
    """Find thrust, inertia, lag, delay, rate gains and drag of a quadrotor in its flight logs."""

    flights: tyro.conf.Positional[tuple[Path, ...]]
    """Flight logs of one vehicle, or folders of them."""
    vehicle: str
    """The vehicle file to start from (or a shipped vehicle's name): mass, arms, what stays."""
    out: Path = Path("vehicle.toml")
    """The vehicle file to write."""
    leave: tuple[str, ...] = ()
    """What to leave as it is: any of drag, motors, inertia, lag, loop."""
    accept: tuple[str, ...] = ()
    """Known faults of the log's interface (names of suite check) that do not stop the command."""
    json: bool = False
    """Print one JSON object to standard output and nothing else."""


def written(config: Config) -> list[Path]:
    """Return the folders that the command writes into."""
    return [config.out.parent]


def run(config: Config, console: Console) -> dict[str, Any]:
    """Identify, and report what is identifiable and what is not.

    Raises:
        ValueError: for flights or a vehicle file that cannot be used.
    """
    from suite.diagnose.identify.run import identify_files

    if config.out.suffix.lower() != ".toml":
        raise ValueError(f"--out is {str(config.out)!r}; its ending must be .toml")
    check_no_input(config.out, [config.vehicle], "--out")
    result = identify_files(
        config.flights, config.vehicle, config.out, config.leave, console, config.accept
    )
    console.say(f"driven by {DRIVEN[result['drive']]}")
    for key, entry in result["parameters"].items():
        values, spans = entry["value"], entry["ci95"]
        if not isinstance(values, list):
            values, spans = [values], [spans]
        # Inertia about z is scaled with those about x and y, of which one is identifiable then.
        left = {2: "goes with the others"} if key == "inertia" else {}
        shown = [
            f"{v:.4g} ({s[0]:.4g} to {s[1]:.4g})" if s else f"{v:.4g} ({left.get(k, 'as it was')})"
            for k, (v, s) in enumerate(zip(values, spans, strict=True))
        ]
        console.say(f"  {key}: {', '.join(shown)} {entry['unit']}")
    for text in result["untold"]:
        console.say(f"  not identifiable from these flights, {text}")
    for warning in result["warnings"]:
        console.say(f"warning: {warning}")
    console.say(f"written: {config.out}")
    return result


DRIVEN = {
    "rotors": "measured rotor speeds",
    "pwm": "motor commands and the battery",
    "torques": "commanded thrust and torques",
    "rates": "commanded thrust and body rates",
    "thrust": "commanded thrust alone",
}

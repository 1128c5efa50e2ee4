"""The command `suite identify`: estimate parameters of a vehicle or sensors file from flights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from suite.common.console import Console
from suite.common.options import Advanced, Command


@dataclass(frozen=True)
class Config(Command):
    """Estimate thrust, inertia, lag, delay, rate gains and drag of a quadrotor from flight logs.

    With --sensors, the errors of its state estimate instead.
    """

    flights: tyro.conf.Positional[tuple[Path, ...]]
    """Flight logs of one vehicle, or folders of them."""
    vehicle: str = ""
    """Start from this vehicle file or shipped vehicle: mass, arms and all parameters that are not
    identifiable come from it. Required without --sensors."""
    sensors: bool = False
    """Write a sensors file instead: the errors of an on-board estimate against the reference in
    the logs."""
    out: Path | None = None
    """The file to write. Without it vehicle.toml, with --sensors sensors.toml."""
    leave: Advanced[tuple[str, ...]] = ()
    """Keep these as they are in --vehicle: any of drag, motors, inertia, lag, loop."""
    accept: Advanced[tuple[str, ...]] = ()
    """Continue in spite of these faults of the logs; the names are those that suite check
    prints."""

    def written(self) -> list[Path]:
        """Return the folders that this command writes; while it runs, no other may write there."""
        return [_out_path(self).parent]


def run(config: Config, console: Console) -> dict[str, Any]:
    """Estimate the parameters, and print which ones are identifiable and which are not.

    Raises:
        ValueError: for flights or a vehicle file that cannot be used.
    """
    out = _out_path(config)
    if config.sensors:
        from suite.diagnose.identify.run import check_out
        from suite.diagnose.sensors.identify import identify_sensors, say_held_out

        check_out(out)
        if config.vehicle or config.leave or config.accept:
            raise ValueError("--sensors takes no --vehicle, --leave and --accept: leave them out")
        result = identify_sensors(config.flights, out, console)
        _show_parameters(result, console)
        say_held_out(result, console)
    else:
        from suite.diagnose.identify.run import identify_files

        if not config.vehicle:
            raise ValueError(
                "--vehicle is missing: the vehicle file to start from, or a shipped name"
            )
        inputs = (config.flights, config.vehicle, out, config.leave)
        result = identify_files(*inputs, console, config.accept)
        console.say(f"driven by {MODEL_INPUTS[result['drive']]}")
        _show_parameters(result, console)
        for text in result["not_identified"]:
            console.say(f"  not identifiable from these flights, {text}")
    for warning in result["warnings"]:
        console.say(f"warning: {warning}")
    console.say(f"written: {out}")
    return result


def _show_parameters(result: dict[str, Any], console: Console) -> None:
    """Print each parameter with its 95 % interval, or a note if it is not identifiable."""
    from tracks.common.figures import with_unit

    for key, entry in result["parameters"].items():
        values, intervals = entry["value"], entry["ci95"]
        if not isinstance(values, list):
            values, intervals = [values], [intervals]
        # The inertia about z (entry 2) is not identifiable alone: it is scaled like those about x
        # and y.
        notes = {2: "goes with the others"} if key == "inertia" else {}
        shown = [
            f"{value:.4g} ({interval[0]:.4g} to {interval[1]:.4g})"
            if interval
            else f"{value:.4g} ({notes.get(k, 'as it was')})"
            for k, (value, interval) in enumerate(zip(values, intervals, strict=True))
        ]
        console.say(with_unit(f"  {key}: {', '.join(shown)}", entry["unit"]))


def _out_path(config: Config) -> Path:
    """Return the file to write."""
    return config.out or Path("sensors.toml" if config.sensors else "vehicle.toml")


MODEL_INPUTS = {
    "rotors": "measured rotor speeds",
    "pwm": "motor commands and the battery",
    "torques": "commanded thrust and torques",
    "rates": "commanded thrust and body rates",
    "thrust": "commanded thrust alone",
}
"""Input of the fitted model, as in the result -> its description."""

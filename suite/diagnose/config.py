"""The options of a diagnosis, from the command line or from Python."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from suite.common.options import Advanced, Command
from suite.diagnose.thresholds import THRESHOLDS
from tracks.input.ranges import Range, Seed


@dataclass(frozen=True)
class Config(Command):
    """Find where flights and a vehicle file disagree, and name the missing effect."""

    flights: tyro.conf.Positional[tuple[Path, ...]]
    """Flight logs, or folders of them."""
    vehicle: str
    """The vehicle file that the simulation used, or a shipped vehicle's name."""
    reference: tuple[Path, ...] = ()
    """Earlier flights of the same vehicle, or folders of them: name what has changed since.
    Without it: name what the vehicle file lacks."""
    out: Path = Path("runs/diagnosis")
    """Folder for diagnosis.json, vehicle.toml, report.html and recording.rrd."""
    drive: Advanced[Literal["auto", "commands", "motors"]] = "auto"
    """Input of the model: logged commands or measured rotor speeds. auto takes the
    commands, but measured speeds where the rate loop does not reproduce them or is a firmware's."""
    integrator: Advanced[Literal["auto", "continuous", "euler"]] = "auto"
    """How the flights were made: continuous (every real flight) or euler (MuJoCo's steps, as long
    as the logs state, else the rate loop's period); auto reads it from the logs."""
    relevance: Advanced[Annotated[tuple[float, float, float], Range(0.0, 1e6)]] = (
        THRESHOLDS.relevance
    )
    """Thresholds of practical relevance: force [m/s^2], angular acceleration [rad/s^2], position
    error after 1 s [m]. An effect below all three is left out. 0 0 0 reports everything
    significant."""
    plan: bool = False
    """Also plan flights that separate the effects which these flights do not; in OUT/plan."""
    no_recording: Advanced[bool] = False
    """Do not write recording.rrd (for rerun): the held-out flights, measured and simulated."""
    accept: Advanced[tuple[str, ...]] = ()
    """Continue in spite of these faults of the logs; the names are those that suite check
    prints."""
    seed: Advanced[Seed] = 0
    """Seed of the permutation test and the intervals."""

    LOCKED = ("out",)

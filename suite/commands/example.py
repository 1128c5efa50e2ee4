"""`suite example`: flights to try `suite diagnose` on, simulated or of a real quadrotor."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from suite.common.console import Console
from suite.common.options import Command


@dataclass(frozen=True)
class Config(Command):
    """Copy short flights into a folder, to try suite diagnose, import and identify on."""

    out: Path = Path("example")
    """Folder for flight_1.parquet to flight_3.parquet and vehicle.toml, or for what is real."""
    real: bool = False
    """Instead: two raw logs of a real quadrotor with their mapping, licence and a README."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Copy the example, and say what to do with it.

    Raises:
        OSError: where the folder cannot be written.
    """
    from suite.diagnose.example.real import real_files
    from tracks.common.files import replacing_file

    config.out.mkdir(parents=True, exist_ok=True)
    copied = real_files() if config.real else _simulated()
    for name, whole in copied.items():
        with replacing_file(config.out / name) as new:
            new.write_bytes(whole)
    names = sorted(copied)
    console.say(f"wrote {', '.join(names)} to {config.out}")
    if config.real:
        console.say(f"next: follow {config.out / 'README.md'} or the tutorial of docs/measure.md")
    else:
        vehicle = config.out / "vehicle.toml"
        console.say(f"next: suite diagnose {config.out} --vehicle {vehicle} --out runs/example")
    return {"folder": str(config.out), "files": names}


def _simulated() -> dict[str, bytes]:
    from importlib.resources import files

    folder = files("suite.diagnose.example").iterdir()
    sources = [file for file in folder if file.name.endswith((".parquet", ".toml"))]
    return {source.name: source.read_bytes() for source in sources}

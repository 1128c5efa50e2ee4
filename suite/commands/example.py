"""`suite example`: flights with a hidden effect, to see what `suite diagnose` says of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from suite.common.console import Console


@dataclass(frozen=True)
class Config:
    """Copy three short flights and their vehicle file into a folder, to try suite diagnose on."""

    out: Path = Path("example")
    """Folder for flight_1.parquet to flight_3.parquet and vehicle.toml."""
    json: bool = False
    """Print one JSON object to standard output and nothing else."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Copy the example, and say what to do with it.

    Raises:
        OSError: where the folder cannot be written.
    """
    from importlib.resources import files

    from tracks.common.files import replacing_file

    config.out.mkdir(parents=True, exist_ok=True)
    names = []
    for source in files("suite.diagnose.example").iterdir():
        if source.name.endswith((".parquet", ".toml")):
            with replacing_file(config.out / source.name) as beside:
                beside.write_bytes(source.read_bytes())
            names.append(source.name)
    vehicle = config.out / "vehicle.toml"
    console.say(f"wrote {', '.join(sorted(names))} to {config.out}")
    console.say(f"now: suite diagnose {config.out} --vehicle {vehicle} --out runs/example")
    return {"folder": str(config.out), "files": sorted(names)}

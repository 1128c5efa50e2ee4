"""The command `suite example`: copy example flights into a folder, simulated or real ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from suite.common.console import Console, command_line
from suite.common.options import Command


@dataclass(frozen=True)
class Config(Command):
    """Copy short flights into a folder, to try suite diagnose, import and identify on."""

    out: Path = Path("example")
    """Folder for flight_1.parquet to flight_3.parquet and vehicle.toml, or for the real logs."""
    real: bool = False
    """Instead: two raw logs of a real quadrotor with their mapping, licence and a README."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Copy the example, and print the next command.

    Raises:
        ValueError: for another file with the name of one of the example's.
        OSError: if the folder cannot be written.
    """
    from tracks.common.files import replacing_file

    config.out.mkdir(parents=True, exist_ok=True)
    contents = _real_files() if config.real else _simulated_files()
    folder = command_line(config.out).encode()
    # The commands of the README read the files of this folder.
    for name in [name for name in contents if ".md" in name]:
        contents[name] = contents[name].replace(b"FOLDER", folder)
    for name, content in contents.items():
        if (path := config.out / name).is_file() and path.read_bytes() != content:
            raise ValueError(
                f"{path} exists, and is not the example's; move it away, or give another --out"
            )
    for name, content in contents.items():
        with replacing_file(config.out / name) as new:
            new.write_bytes(content)
    names = sorted(contents)
    console.say(f"wrote {', '.join(names)} to {config.out}")
    if config.real:
        console.say(f"next: follow {config.out / 'README.md'} or the tutorial of docs/measure.md")
    else:
        from eval.logs.flight_log import logs_in

        vehicle, flights = config.out / "vehicle.toml", [config.out]
        logs = [path for path in logs_in(config.out) if path.name in contents]
        if others := len(logs_in(config.out)) - len(logs):
            text = f"{config.out} holds {others} flight(s) that are not the example's"
            console.note(f"warning: {text}")
            flights = logs
        options = ["--vehicle", vehicle, "--out", "runs/example"]
        console.say(f"next: {command_line('suite', 'diagnose', *flights, *options)}")
    return {"folder": str(config.out), "files": names}


def _real_files() -> dict[str, bytes]:
    """Return the real logs, their mapping and their licence, uncompressed, by file name.

    README.md next to them states their source, licence and changes; every copy has it.
    """
    import lzma
    from importlib.resources import files

    mapping = "nanobench.toml"
    contents = {mapping: files("eval.importers.mappings").joinpath(mapping).read_bytes()}
    for source in files("suite.diagnose.example.real").iterdir():
        if source.name.endswith((".csv.xz", ".yaml", ".md", "LICENSE")):
            data = source.read_bytes()
            is_packed = source.name.endswith(".xz")
            contents[source.name.removesuffix(".xz")] = lzma.decompress(data) if is_packed else data
    return contents


def _simulated_files() -> dict[str, bytes]:
    """Return the content of the simulated flights and their vehicle file, by name."""
    from importlib.resources import files

    folder = files("suite.diagnose.example").iterdir()
    sources = [file for file in folder if file.name.endswith((".parquet", ".toml"))]
    return {source.name: source.read_bytes() for source in sources}

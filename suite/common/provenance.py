"""Write run.json, the record of a run: versions, machine, command and resolved configuration."""

from __future__ import annotations

import importlib.metadata as metadata
import os
import platform
import sys
from pathlib import Path
from typing import Any

import psutil

from tracks.common.files import write_json
from tracks.common.provenance import stamp
from tracks.common.work import usable_cores
from tracks.input.reading import read_json

PACKAGES = (
    *("numpy", "scipy", "jax", "jaxlib", "optax", "safetensors", "mujoco", "mujoco-mjx"),
    *("dm-control", "gymnasium", "trimesh", "torch", "rotorpy", "onnx", "onnxruntime"),
    *("pyarrow", "rerun-sdk"),
)
"""Names of the packages that can change a result."""


def package_versions() -> dict[str, str | None]:
    """Return the installed version of each of `PACKAGES`; None if it is missing."""
    versions: dict[str, str | None] = {}
    for name in PACKAGES:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            versions[name] = None
    return versions


def machine() -> dict[str, Any]:
    """Return the system, processor, number of usable cores and memory [bytes] of this machine."""
    return {
        "system": platform.platform(),
        "processor": _processor(),
        "cores": usable_cores(),
        "memory_bytes": psutil.virtual_memory().total,
    }


def _processor() -> str:
    """Return the model name of the processor."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in text.splitlines() if "model name" in line]
    return names[0] if names else platform.machine()


def run_record(config: Any, seed: int | None) -> dict[str, Any]:
    """Return everything that is needed to repeat a run: stamp, versions, machine and `config`.

    Args:
        config: the configuration with all defaults filled in, a dataclass.
        seed: seed of the run; None if it has none.
    """
    return {
        **stamp(schema=1, seed=seed),
        "python": platform.python_version(),
        "packages": package_versions(),
        "machine": machine(),
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "config_type": _type_name(config),
        "config": config,
    }


def _type_name(config: Any) -> str:
    """Return the full name of a configuration's class, which shows the kind of a run."""
    return f"{type(config).__module__}.{type(config).__qualname__}"


def refuse_other_run(folder: str | os.PathLike[str], config: Any) -> None:
    """Refuse a folder with a run of another kind, whose record would be overwritten.

    Raises:
        ValueError: with the folder and the command that made it.
    """
    path = Path(folder) / "run.json"
    try:
        record = read_json(path)
        kind, command = record["config_type"], " ".join(map(str, record["command"][:2]))
    except (OSError, ValueError, KeyError, TypeError):
        return
    if kind != _type_name(config):
        raise ValueError(
            f"{folder} holds a run of another kind (made by {command}), whose run.json would be "
            "overwritten; give another --out"
        )


def write_run_record(
    folder: str | os.PathLike[str], config: Any, seed: int | None, resumed: bool = False
) -> None:
    """Write `run_record` to `folder`/run.json.

    Args:
        folder: folder of the run.
        config: the configuration with all defaults filled in, a dataclass.
        seed: seed of the run; None if it has none.
        resumed: whether an interrupted run in this folder continues. The git commits in its record
            are then kept as `earlier_commits`, since their code made a part of the run.

    Raises:
        ValueError: if the existing record cannot be read.
    """
    path, record = Path(folder) / "run.json", run_record(config, seed)
    commits: set[str] = set()
    if resumed and path.is_file():
        try:
            old_record = read_json(path)
            commits = {
                *old_record.get("earlier_commits", []),
                old_record["git_commit"] or "unknown",
            }
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: not the record of a run ({error}); move it away") from error
    earlier = sorted(commits - {record["git_commit"]})
    write_json(path, {**record, "earlier_commits": earlier} if earlier else record)

"""Write run.json, the record of a run: versions, machine, command and resolved configuration."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata as metadata
import os
import platform
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import psutil

from tracks.common.files import write_json
from tracks.common.names import added_entries
from tracks.common.provenance import differences, stamp
from tracks.common.work import usable_cores
from tracks.input.reading import read_json

PACKAGES = (
    *("numpy", "scipy", "jax", "jaxlib", "optax", "safetensors", "mujoco", "mujoco-mjx"),
    *("dm-control", "gymnasium", "trimesh", "torch", "rotorpy", "onnx", "onnxruntime"),
    *("pyarrow", "rerun-sdk"),
)
"""Names of the packages that can change a result."""
_TRAINED_WITH = ("numpy", "scipy", "jax", "jaxlib", "optax", "mujoco")
"""Names of those that can change a training."""


@functools.cache
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
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in text.splitlines() if "model name" in line]
    return names[0] if names else platform.machine()


@functools.cache
def engines() -> dict[str, str | None]:
    """Return what else affects a result: the processor, versions of packages, and the plugins.

    A plugin is an installed Python package that adds effects, tracks or simulators.
    """
    versions = package_versions()
    names = ("numpy", "scipy", "jax", "jaxlib", "optax", "mujoco", "mujoco-mjx", "torch")
    return {
        "processor": machine()["processor"],
        **{name: versions[name] for name in (*names, "onnxruntime", "rotorpy")},
        "added": added_digest(),
    }


def added_digest() -> str | None:
    """Return a digest (16 hex digits) of the plugins' effects, tracks and simulators, if any."""
    sha256 = hashlib.sha256()
    entries = added_entries()
    for entry in entries:
        sha256.update(f"{entry.group}\0{entry.name}\0{entry.value}\0".encode())
        for path in _sources(entry.module.partition(".")[0]):
            sha256.update(path.name.encode() + b"\0" + path.read_bytes())
    return sha256.hexdigest()[:16] if entries else None


def _sources(module: str) -> list[Path]:
    """Return the source files of a module or a package; none if it is missing."""
    spec = find_spec(module)
    if spec is None:
        return []
    folders = spec.submodule_search_locations or ()
    files = [path for folder in folders for path in Path(folder).rglob("*.py")]
    if not files and spec.origin is not None:
        files = [Path(spec.origin)]
    return sorted(path for path in files if path.is_file())


def _type_name(config: Any) -> str:
    """Return the full name of a configuration's class, which shows the kind of a run."""
    return f"{type(config).__module__}.{type(config).__qualname__}"


def is_marked(path: Path, mark: str) -> bool:
    """Return whether `path` is a file with `mark` in its first line, a comment.

    A command marks the TOML files that it writes.
    """
    if not path.is_file():
        return False
    first_line = path.read_text("utf-8", "replace").partition("\n")[0]
    return first_line.startswith("#") and mark in first_line


def refuse_foreign(path: Path, mark: str) -> None:
    """Refuse to overwrite a file without the `mark` of the command, which did not write it.

    Raises:
        ValueError: naming the file, and what to do.
    """
    if path.is_file() and not is_marked(path, mark):
        raise ValueError(
            f"{path} exists, and this command did not write it; move it away, or give another --out"
        )


def refuse_policy_folder(folder: str | os.PathLike[str]) -> None:
    """Refuse a run in the folder of a policy, whose training replaces all that is in it.

    Raises:
        ValueError: naming the folder, and what to give instead.
    """
    from policies.formats.checkpoint import CONFIG, WEIGHTS

    for place in (Path(folder), *Path(folder).absolute().parents):
        if all((place / name).is_file() for name in (CONFIG, WEIGHTS)):
            where = "is" if place == Path(folder) else "is in"
            raise ValueError(
                f"--out {folder} {where} the folder of a policy; give a folder for the new run"
            )


def refuse_other_run(folder: str | os.PathLike[str], config: Any) -> None:
    """Refuse the folder of a policy, and one with a run of another kind, which has its own record.

    Raises:
        ValueError: with the folder and the command that made it.
    """
    refuse_policy_folder(folder)
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
) -> list[str]:
    """Write everything that is needed to repeat a run to `folder`/run.json.

    The dataclass `config` has all defaults filled in. The seed is None if the run has none. With
    `resumed`, an interrupted run in this folder continues. Versions in its record that have changed
    since are kept under `earlier`, as they made a part of the run.

    Returns:
        These changes of versions, plugins or processor, such as "jax is 0.9.0 there, 0.9.1 here".

    Raises:
        ValueError: if the existing record cannot be read.
    """
    path = Path(folder) / "run.json"
    record = {
        **stamp(schema=1, seed=seed),
        "python": platform.python_version(),
        "packages": package_versions(),
        "plugins": added_digest(),
        "machine": machine(),
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "config_type": _type_name(config),
        "config": config,
    }
    changes = []
    if resumed and path.is_file():
        try:
            old_record = read_json(path)
            before, now = _made_with(old_record), _made_with(record)
            earlier = {
                name: sorted({*old_record.get("earlier", {}).get(name, []), before[name]} - {value})
                for name, value in now.items()
            }
            if any(earlier.values()):
                record["earlier"] = {name: values for name, values in earlier.items() if values}
            changes = differences(before, now)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"{path}: not the record of a run ({error}); move it away") from error
    write_json(path, record)
    return changes


def _made_with(record: dict[str, Any]) -> dict[str, str]:
    """Return what affects a training, by its name, from the record of a run."""
    packages = record.get("packages", {})
    return {
        "suite_version": record.get("suite_version") or "unknown",
        "git_commit": record.get("git_commit") or "unknown",
        "plugins": record.get("plugins") or "none",
        "processor": record.get("machine", {}).get("processor") or "unknown",
        **{name: packages.get(name) or "none" for name in _TRAINED_WITH},
    }

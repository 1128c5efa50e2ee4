"""The command `suite info`: print versions, devices and memory, for a bug report."""

from __future__ import annotations

import platform
import sys
from dataclasses import dataclass
from typing import Any

import psutil

from suite.common.console import Console, size
from suite.common.options import Command
from suite.common.provenance import machine, package_versions
from tracks.common.provenance import VERSION, git_commit


@dataclass(frozen=True)
class Config(Command):
    """Show versions, devices, memory and commit."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Collect and print the facts; if JAX cannot find its devices, its error is printed."""
    facts: dict[str, Any] = {
        "suite": VERSION,
        "git_commit": git_commit(),
        "python": f"{platform.python_version()} at {sys.executable}",
        "machine": machine(),
        "memory_free_bytes": psutil.virtual_memory().available,
        "jax_devices": _jax_devices(),
        "packages": package_versions(),
    }
    computer = facts["machine"]
    console.say(f"suite      {VERSION}, commit {facts['git_commit'] or 'unknown'}")
    console.say(f"python     {facts['python']}")
    console.say(f"system     {computer['system']}")
    console.say(f"processor  {computer['processor']}, {computer['cores']} usable cores")
    free, total = size(facts["memory_free_bytes"]), size(computer["memory_bytes"])
    console.say(f"memory     {free} free of {total}")
    console.say(f"jax        {', '.join(facts['jax_devices'])}")
    for name, version in facts["packages"].items():
        console.say(f"  {name:<13}{version or 'missing'}")
    return facts


def _jax_devices() -> list[str]:
    """Return a line about each device that JAX finds, or its error message."""
    try:
        import jax

        return [f"{d.platform}:{d.id} {d.device_kind}" for d in jax.devices()]
    except Exception as error:  # the report may be about a broken driver
        return [f"not usable: {error}"]

"""`suite export`: a policy of ours for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from suite.common.console import Console, size


@dataclass(frozen=True)
class Config:
    """Write a policy of ours as torch exported program (.pt2) and ONNX (.onnx)."""

    policy: tyro.conf.Positional[str] = ""
    """A shipped policy's name or a checkpoint's folder; by default the shipped policy."""
    formats: tuple[str, ...] = ("torch", "onnx")
    """Which of torch and onnx."""
    out: Path = Path("runs/export")
    """Folder for the files."""
    json: bool = False
    """Print one JSON object to standard output and nothing else."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Write the files and say where they are.

    Raises:
        ValueError: where the policy is not ours or a format is unknown.
    """
    from policies.formats.export import export_policy
    from suite.judging.flying import default_policy

    written = export_policy(config.policy or default_policy(), config.out, config.formats)
    for path in written:
        console.say(f"written: {path} ({size(path.stat().st_size)})")
    return {"written": written}

"""The command `suite export`: write a policy of the suite as torch program, ONNX or C."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from suite.common.console import Console, size
from suite.common.options import Advanced, Command


@dataclass(frozen=True)
class Config(Command):
    """Write a policy of the suite as torch program (.pt2), ONNX (.onnx) or C (policy.h, .c)."""

    policy: str = ""
    """A shipped policy's name or a checkpoint's folder. Without it the policy race."""
    formats: Annotated[tuple[str, ...], tyro.conf.arg(name="format")] = ("torch", "onnx")
    """One or more of torch, onnx and c."""
    dtype: Advanced[str] = "float32"
    """Type of the weights in C: float32 or int8."""
    out: Path = Path("runs/export")
    """Folder for the files."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Write the files and print their paths."""
    from suite.judging.deploy.exporting import export
    from suite.judging.flying import default_policy

    policy = config.policy or default_policy()
    answer = export(policy, config.out, config.formats, config.dtype, console)
    for path in answer["written"]:
        console.say(f"written: {path} ({size(path.stat().st_size)})")
    return answer

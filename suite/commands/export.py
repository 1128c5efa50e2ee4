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

    name: tyro.conf.Positional[str] = ""
    """A shipped policy's name or a checkpoint's folder. Without it the policy race."""
    policy: str = ""
    """The same as NAME."""
    formats: Annotated[tuple[str, ...], tyro.conf.arg(name="format")] = ("torch", "onnx")
    """One or more of torch, onnx and c."""
    dtype: Advanced[str] = "float32"
    """Type of the weights in C: float32 or int8."""
    out: Path = Path("runs/export")
    """Folder for the files."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Write the files and print their paths."""
    from policies import shipped
    from policies.formats.export import FORMATS
    from suite.judging.deploy.exporting import export
    from suite.judging.flying import default_policy

    if config.name and config.policy and config.name != config.policy:
        raise ValueError(f"--policy {config.policy}: NAME is {config.name}; give one of them")
    policy, formats = config.policy or config.name, config.formats
    last = formats[-1] if formats else FORMATS[0]
    if not policy and last not in FORMATS and (last in shipped.names() or Path(last).exists()):
        # In `--format c race` the list takes all words after it, also the policy's name.
        *formats, policy = formats
    answer = export(policy or default_policy(), config.out, formats, config.dtype, console)
    for path in answer["written"]:
        console.say(f"written: {path} ({size(path.stat().st_size)})")
    return answer

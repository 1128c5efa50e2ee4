"""The command `suite bench`: compare the speed of a core part with a plain implementation."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any

import tyro

from suite.common.console import Console
from suite.common.options import Command
from suite.experiments.bench import BENCHES
from tracks.common.files import plain
from tracks.common.grid import rich_table
from tracks.common.names import unknown_name


@dataclass(frozen=True)
class Config(Command):
    """Compare the speed of a core function with a plain implementation; without NAME, list all."""

    name: tyro.conf.Positional[str] = ""
    """The benchmark to run. Without it all are listed."""
    policy: str | None = None
    """For the benchmark `policy`: a shipped policy's name or a checkpoint's folder. Without it the
    policy race."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Run the benchmark `config.name`, and show the speeds of both sides and their ratio."""
    if not config.name:
        config.refuse_unused(["policy"], "no benchmark is named")
        for name, summary in BENCHES.items():
            console.say(f"{name:<12} {summary}")
        return {"benches": BENCHES}
    if config.name not in BENCHES:
        raise unknown_name("benchmark", config.name, BENCHES)
    if config.name != "policy":
        config.refuse_unused(["policy"], f"the benchmark {config.name} measures no policy")
    from suite.experiments.bench.compare import load_warnings

    # Measured before the benchmark, while this process is idle.
    load = load_warnings()
    bench = importlib.import_module(f"suite.experiments.bench.{config.name}")
    result = bench.run() if config.policy is None else bench.run(config.policy)
    answer: dict[str, Any] = plain(result)
    answer |= {"ratio": result.ratio, "warnings": [*load, *result.warnings]}
    del answer["grid"]
    for side, figure in (("ours", result.ours), ("baseline", result.baseline)):
        console.say(f"{side:<9} {figure.value:.4g} {figure.unit}")
    console.say(f"ratio     {result.ratio:.2f} (above 1: ours is faster)")
    if result.grid:
        console.show(rich_table(result.grid))
    for name, value in ({} if result.grid else answer["details"]).items():
        console.say(f"{name}: {value}")
    for warning in answer["warnings"]:
        console.note(f"warning: {warning}")
    return answer

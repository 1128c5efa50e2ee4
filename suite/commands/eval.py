"""`suite eval`: judge policies on tracks they have not seen, in a quadrotor they do not know."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from suite.common.console import Console


@dataclass(frozen=True)
class Config:
    """Fly trials and write the result tables; two policies or more are compared in pairs."""

    track: str = "all"
    """zigzag, circular, ellipse, all of these, a track file (.toml), or a list with commas."""
    difficulty: str = "0"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: int = 10
    """Trials of every policy on every track at every level."""
    policy: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A shipped policy's name, a checkpoint's folder, or a .onnx, .pt2 or .pt file; may be given
    several times. Without it the shipped policy flies."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""
    world: str = "mujoco"
    """mujoco (fast on CPUs), mjx (for GPUs) or reference (slow and simple)."""
    seed: int = 0
    """Seed of the first trial; the others follow by one."""
    out: Path = Path("runs/eval")
    """Folder for trials.parquet, table.md, summary.json and run.json."""
    procs: int | None = None
    """Processes that share the trials; by default as many cores as are worth it."""
    deadline_s: float | None = None
    """A policy's answer for a batch that takes longer is late and not flown [s]."""
    trust: bool = False
    """Also load policy files that can run code on this machine."""
    rerun: Path | None = None
    """Also write a rerun recording (.rrd) of the first trial of every track and level."""
    json: bool = False
    """Print one JSON object to standard output and nothing else."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Judge as `config` says.

    Raises:
        ValueError: for anything that cannot be used, before the first flight.
    """
    from suite.judging.evaluate import Judgement, evaluate

    judgement = Judgement(
        policies=tuple(config.policy),
        track=config.track,
        difficulty=config.difficulty,
        trials=config.trials,
        seed=config.seed,
        vehicle=config.vehicle,
        world=config.world,
        processes=config.procs,
        deadline_s=config.deadline_s,
        trust=config.trust,
    )
    if config.rerun and config.rerun.suffix != ".rrd":
        raise ValueError(f"--rerun {config.rerun}: a recording's name must end in .rrd")
    answer = evaluate(judgement, config.out, console)
    if config.rerun:
        from suite.judging.replay import record_first_trials

        record_first_trials(judgement, config.rerun, console)
        answer["rerun"] = str(config.rerun)
    return answer

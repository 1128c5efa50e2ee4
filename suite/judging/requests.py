"""The options of the commands that fly a policy: `suite eval`, `suite collect` and `suite fly`.

Each class is a command's request: which policy flies on which tracks, how often and in which
simulator. run.json records it, and `trials.py` reads the tracks, levels and files that it names.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from suite.common.options import Advanced
from tracks.input.ranges import Range, Seed, TimeLimit, Trials


@dataclass(frozen=True)
class Flights:
    """Trials on tracks with a vehicle: options of all commands that fly a policy."""

    track: str = "all"
    """zigzag, circular, ellipse, all of these, random, a track file (.toml), or a list with
    commas."""
    difficulty: str = "0,3"
    """Level from 0 (easy) to 9 (hard); several levels as 0,3,9 or 0-3 or all."""
    trials: Trials = 10
    """Trials of every policy on every track at every level."""
    seed: Seed = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""
    time_limit_s: Advanced[TimeLimit] = 20.0
    """A trial ends at this time [s]; a long track from a file may need more than the tables' 20."""
    trust: Advanced[bool] = False
    """Also load policy files that can run code on this machine (.pt2, .pt, .c)."""


@dataclass(frozen=True)
class SimulatedFlights(Flights):
    """Flights with a choice of simulator and sensors."""

    simulator: str = "mujoco"
    """mujoco (fast on CPUs), mjx (for GPUs), rotorpy (needs pip install
    'diffracing-suite[rotorpy]'), or the simulator of an installed package."""
    sensors: str = "perfect"
    """Errors in what the policy sees: a shipped name (perfect, vio, stereo-depth, ...) or a sensors
    file (.toml). Recorded logs have the true state, with the log
    faults of the vehicle file."""


@dataclass(frozen=True)
class Evaluation(SimulatedFlights):
    """Policies, trials and simulation; `suite eval` has these as options."""

    policies: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="policy")
    ] = ()
    """A shipped policy's name, a checkpoint's folder, or a .onnx, .pt2, .pt or .c file; may be
    given several times. Without it the policy race flies."""
    speed: Annotated[tuple[float, ...], Range(0.0, 1.0)] = ()
    """For policies with a speed input: 0 (careful) to 1 (a race); with several values all trials
    are flown at each. Without it each policy flies at its own default speed."""
    deadline_s: Advanced[Annotated[float, Range(0.0, 3600.0, above=True)] | None] = None
    """If an answer of the policy takes longer than this, the trials that wait for it (up to 128, in
    one batch) end as timed out [s]. Without it a policy may take any time."""
    monitor: Advanced[bool] = False
    """Also fly every policy a second time on the same trials, inside the safety monitor that limits
    its actions."""


@dataclass(frozen=True)
class Collection(SimulatedFlights):
    """Which flights are recorded; `suite collect` has these as options."""

    policy: str = ""
    """A shipped policy's name, a checkpoint's folder, or a policy file. Without it the policy race
    flies."""
    trials: Trials = 5
    """Flights on every track at every level."""
    speed: Annotated[float, Range(0.0, 1.0)] | None = None
    """For a policy with a speed input: 0 (careful) to 1 (a race). Without it the policy's own."""
    seed: Seed = 100_000
    """Seed of the first trial; the default is far from the seeds of suite eval."""

"""The options of `suite loop`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from suite.common.options import Advanced, Command
from suite.common.work import WorkersOption
from tracks.input.ranges import SEED_MOST, Iterations, Range, Trials


@dataclass(frozen=True)
class Config(Command):
    """Fly, find what the simulation lacks, fine-tune for it, and fly again, next to a control.

    The same command again continues where it was stopped.
    """

    recipe: str | None = None
    """The recipe: race, race-small, race-paper, quick, gpu or paper. Without it the recipe of
    --policy, or race."""
    policy: str | None = None
    """Start from this policy instead of training one: a shipped name or a checkpoint's folder."""
    track: str = "all"
    """zigzag, circular, ellipse, all of these, or a list with commas."""
    difficulty: str = "0,3"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials | None = None
    """Trials of each policy on every track at every level. Without it 50, with quick 20; with a
    hidden vehicle 25."""
    flights: Trials | None = None
    """Recorded flights on every track at every level. Without it 20, with quick 8; with a hidden
    vehicle 3."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""
    hidden_vehicle: str | None = None
    """A vehicle file with an effect that --vehicle lacks: fly it, name the effect, fine-tune
    through the corrected quadrotor. Without it flights of --vehicle are recorded."""
    simulator: str = "mujoco"
    """The simulator of the hidden vehicle. With another one than mujoco (such as rotorpy) and no
    --hidden-vehicle, the hidden difference is that between the simulators."""
    sensors: Advanced[str] = "perfect"
    """Errors in what the policies see, in every flight: a shipped name or a sensors file."""
    seed: Annotated[int, Range(0, SEED_MOST - 10**6)] = 0
    """Seed of the training and of the first trial; recorded flights begin 100,000 above."""
    iterations: Advanced[Iterations | None] = None
    """Gradient steps of the training, instead of the recipe's."""
    finetune_iterations: Advanced[Iterations | None] = None
    """Gradient steps of each fine-tuning. Without it a quarter of the last phase's; with a hidden
    vehicle 60."""
    fit_iterations: Advanced[Iterations | None] = None
    """Gradient steps of the Delta Action Model's fit. Without it 1500, with quick 500; with a
    hidden vehicle 200."""
    no_delta: Advanced[bool] = False
    """With a hidden vehicle: leave out the Delta Action Models and the fine-tunings with them.
    This halves the time."""
    set: Advanced[tuple[str, ...]] = ()
    """Change settings of the recipe by name, such as loss.progress=0.4 episode.batch=128."""
    out: Path = Path("runs/loop")
    """Folder of the loop; an unfinished loop in it continues."""
    workers: WorkersOption = None
    """Share flights and fine-tunings among N processes of this machine, or on the cluster at
    HOST:PORT, whose owner can run code here. Without it flights use as many cores as shorten the
    work, and one process fine-tunes."""

    LOCKED = ("out",)

"""`suite loop`: train, fly, record, fit the Delta Action Model, fine-tune, fly again."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from suite.common.console import Console
from suite.common.work import WorkersOption, workers_given
from tracks.input.ranges import SEED_MOST, Iterations, Range, Trials


@dataclass(frozen=True)
class Config:
    """Close the loop and show what the Delta Action Model changes, on the same seeds.

    The same command again goes on where it was stopped.
    """

    recipe: str | None = None
    """The recipe: race, race-small, race-paper, quick, gpu or paper. By default that of the policy
    to start from, or race."""
    policy: str | None = None
    """Start from this policy instead of training one: a shipped name or a checkpoint's folder."""
    track: str = "all"
    """zigzag, circular, ellipse, all of these, or a list with commas."""
    difficulty: str = "0,3"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials | None = None
    """Trials of each policy on every track at every level; by default 50, or 20 with quick; with
    a hidden vehicle 25, or 20."""
    flights: Trials | None = None
    """Recorded flights on every track at every level; by default 20, or 8 with quick; with a hidden
    vehicle 3."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""
    hidden_vehicle: str | None = None
    """A vehicle file with an effect that --vehicle lacks: fly it, name the effect, fine-tune
    through the corrected quadrotor. Without --policy the shipped one flies."""
    simulator: str = "mujoco"
    """What flies the hidden vehicle. With another simulator than mujoco (such as rotorpy) and no
    --hidden-vehicle, what that simulator does otherwise with --vehicle is what is hidden."""
    sensors: str = "perfect"
    """What policies see of the truth, in every flight: shipped sensors' name or a sensors file."""
    seed: Annotated[int, Range(0, SEED_MOST - 10**6)] = 0
    """Seed of the training and of the first trial; recorded flights begin 100,000 above."""
    iterations: Iterations | None = None
    """Gradient steps of the training, instead of the recipe's."""
    finetune_iterations: Iterations | None = None
    """Gradient steps of each fine-tuning; by default a quarter of the recipe's; with a hidden
    vehicle 60, or 100 with quick."""
    fit_iterations: Iterations | None = None
    """Gradient steps of the Delta Action Model's fit; by default 1500, or 500 with quick; with
    a hidden vehicle 200."""
    no_delta: bool = False
    """Leave out the Delta Action Models and the fine-tunings under them, which take half the time;
    with a hidden vehicle."""
    set: tuple[str, ...] = ()
    """Change settings of the recipe by name, such as loss.progress=0.4 episode.batch=128."""
    out: Path = Path("runs/loop")
    """Folder of the loop; a loop that stands there is gone on with."""
    workers: WorkersOption = None
    """Who shares the flights and the fine-tunings: N processes of this machine, or ADDRESS, a
    cluster's. Without it as many processes fly as are worth it, and one fine-tunes."""
    json: bool = False
    """Print one JSON object to standard output and nothing else."""


OTHER = ("set", "no_delta", "out", "workers", "json")
"""Options that `suite.loop.config.resolve` does not take by these names."""


def written(config: Config) -> list[Path]:
    """Return the folders that the command writes into."""
    return [config.out]


def run(config: Config, console: Console) -> dict[str, Any]:
    """Run the loop, or the rest of it.

    Raises:
        ValueError: for anything that cannot be used, before the first stage.
    """
    from suite.loop.config import resolve
    from suite.loop.run import run_loop

    workers = workers_given(config.workers, whole_cores=True)
    about_loop = {name: value for name, value in vars(config).items() if name not in OTHER}
    resolved = resolve(**about_loop, delta=not config.no_delta, changes=config.set)
    return run_loop(resolved, config.out, console, workers)

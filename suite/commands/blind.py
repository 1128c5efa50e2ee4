"""`suite blind`: test cases with hidden effects for the diagnosis, made, diagnosed and scored."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from suite.common.console import Console
from suite.common.options import Command
from suite.common.work import WorkersOption, workers_given
from tracks.input.ranges import Range, Seed

if TYPE_CHECKING:
    from suite.blind.make import Manifest


@dataclass(frozen=True)
class Config(Command):
    """Make cases with hidden effects, run the diagnosis on them, score it against the answers."""

    what: tyro.conf.Positional[Literal["make", "run", "score", "strengths", "plan"]]
    """make: write a set of cases; run: `suite diagnose` on each; score: compare the answers with
    the truth; strengths: compute the table of detectable strengths; plan: which flights separate
    --effects."""
    out: Path = Path("runs/blind")
    """Folder of the set; the same command again continues where it stopped."""
    set: Literal["tuning", "published"] = "tuning"
    """Which seeds: tuning ones for development, published ones for the results page."""
    seed: Seed | None = None
    """Seed of a set of your own, in place of --set."""
    count: Annotated[int, Range(1, 100_000)] | None = None
    """About how many cases, at least one of every kind. Without it all 244, or 60 with another
    simulator."""
    simulator: Literal["mujoco", "rotorpy", "continuous"] = "mujoco"
    """What simulates the cases: mujoco, rotorpy (needs pip install 'diffracing-suite[rotorpy]'), or
    continuous, an engine in continuous time that shares no code with the fitted model."""
    effects: tuple[str, ...] = ()
    """For plan: effects that your flights do not separate."""
    workers: WorkersOption = None
    """For make and run: share the cases among N processes of this machine, or on the cluster at
    HOST:PORT, whose owner can run code here. Without it one case follows the other."""

    def written(self) -> list[Path]:
        """Return the folders into which no other command may write meanwhile."""
        return [self.out] if self.what in ("make", "run") else []


TAKEN = {
    "out": ("make", "run", "score"),
    "set": ("make",),
    "seed": ("make",),
    "count": ("make",),
    "simulator": ("make",),
    "effects": ("plan",),
    "workers": ("make", "run"),
}
"""Which of the command's works take an option."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Do `config.what`.

    Raises:
        ValueError: for an option of another work, a folder that holds another set, or names that
            are not in the catalogue.
    """
    for name, works in TAKEN.items():
        given = getattr(config, name)
        if config.what not in works and given != getattr(Config, name):
            shown = " ".join(given) if isinstance(given, tuple) else given
            raise ValueError(
                f"--{name} is {shown}, but `suite blind {config.what}` does not take it, only "
                f"{' and '.join(works)}; leave it out"
            )
    workers = workers_given(config.workers, whole_cores=True)
    if config.what == "plan":
        return _plan(config, console)
    if config.what == "strengths":
        return _strengths(console)
    if config.what == "make":
        from suite.blind.cases import SETS
        from suite.blind.make import make_set

        seed = SETS[config.set] if config.seed is None else config.seed
        made = make_set(config.out, seed, config.count, console, config.simulator, workers)
        return _made(made, config, console)
    if config.what == "run":
        from suite.blind.run import diagnose_by_command, run_set
        from suite.cli import COMMANDS

        if "diagnose" not in COMMANDS:
            raise ValueError("this version has no `suite diagnose`; run_set takes any function")
        done = run_set(config.out, diagnose_by_command, console, workers=workers)
        console.say(f"{done} cases diagnosed; score them with `suite blind score`")
        return {"diagnosed": done, "out": str(config.out)}
    from suite.blind.score import not_run, report, score_set, shares
    from tracks.common.files import plain

    verdicts = score_set(config.out)
    console.say(report(config.out, verdicts))
    return {
        "out": str(config.out),
        "shares": plain(shares(verdicts)),
        "not_run": not_run(config.out, verdicts),
        "cases": plain(verdicts),
    }


def _made(manifest: Manifest, config: Config, console: Console) -> dict[str, Any]:
    from tracks.common.files import plain

    count = len(manifest.cases)
    console.say(f"{count} cases in {config.out / 'cases'}, answers in {config.out / 'answers'}")
    for name in manifest.failed:
        console.note(f"warning: {name} could not be made; why is in answers/failed.json")
    return {"out": str(config.out), "made": count, "failed": plain(manifest.failed)}


def _strengths(console: Console) -> dict[str, Any]:
    from suite.blind.oracle.strength import write_table

    path = write_table(console)
    console.say(f"written: {path}")
    return {"table": str(path)}


def _plan(config: Config, console: Console) -> dict[str, Any]:
    from eval.effects import find_effect
    from suite.diagnose.plan import plan_for, separations_of
    from tracks.common.files import plain

    names = [find_effect(name).name for name in config.effects]
    if len(names) < 2:
        raise ValueError(f"--effects {names}: give at least two names that are to be separated")
    for entry in separations_of(names):
        console.say(f"{' or '.join(entry.pair)}: {entry.words}")
    for way in plan_for(names):
        console.say(f"  {way.kind}, {way.duration_s:g} s, to {way.speed:g} m/s, yaw {way.turn}")
    return {"flights": plain(plan_for(names))}

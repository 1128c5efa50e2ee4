"""The command `suite blind`: make test cases with hidden effects, diagnose them, score the answers.

The true effects of the cases (the answers) are in a folder that the diagnosis does not read.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from suite.common.console import Console, counted
from suite.common.options import Command
from suite.common.work import WorkersOption, read_workers_option
from tracks.common.files import plain
from tracks.input.ranges import Range, Seed


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
    """Seeds of the cases: tuning for development, published for the results page."""
    seed: Seed | None = None
    """Seed of another set, instead of --set."""
    count: Annotated[int, Range(1, 100_000)] | None = None
    """Approximate number of cases, at least one of every kind. Without it about 250, or 60 with
    another simulator."""
    simulator: Literal["mujoco", "rotorpy", "continuous"] = "mujoco"
    """What simulates the cases: mujoco, rotorpy (needs pip install 'diffracing-suite[rotorpy]'), or
    continuous, an engine in continuous time that shares no code with the fitted model."""
    effects: tuple[str, ...] = ()
    """For plan: two or more effects that your flights do not separate."""
    workers: WorkersOption = None
    """For make and run: share the cases among N processes of this machine, or on the cluster at
    HOST:PORT, whose owner can run code here. Without it one case follows the other."""

    def written(self) -> list[Path]:
        """Return the folders that this command writes; while it runs, no other may write there."""
        return [self.out] if self.what in ("make", "run") else []


USED_BY = {
    "out": ("make", "run", "score"),
    "set": ("make",),
    "seed": ("make",),
    "count": ("make",),
    "simulator": ("make",),
    "effects": ("plan",),
    "workers": ("make", "run"),
}
"""Option -> the actions (`what`) that use it."""


def run(config: Config, console: Console) -> dict[str, Any]:
    """Do the action `config.what`."""
    for name, actions in USED_BY.items():
        if config.what not in actions:
            users = " and ".join(actions)
            reason = f"`suite blind {config.what}` does not take it, only {users}"
            config.refuse_unused([name], reason)
    if config.seed is not None:
        config.refuse_unused(["set"], f"--seed {config.seed} makes another set")
    workers = read_workers_option(config.workers, whole_cores=True)
    if config.what == "plan":
        return _plan(config, console)
    if config.what == "strengths":
        from suite.blind.oracle import write_table

        path = write_table(console)
        console.say(f"written: {path}")
        return {"table": str(path)}
    if config.what == "make":
        from suite.blind.cases import SETS
        from suite.blind.make import make_set

        seed = SETS[config.set] if config.seed is None else config.seed
        manifest = make_set(config.out, seed, config.count, console, config.simulator, workers)
        count, out = len(manifest.cases), config.out
        console.say(f"{counted(count, 'case')} in {out / 'cases'}, answers in {out / 'answers'}")
        for name in manifest.failed:
            console.note(f"warning: {name} could not be made; answers/failed.json has the reason")
        return {"out": str(out), "made": count, "failed": plain(manifest.failed)}
    if config.what == "run":
        from suite.blind.run import diagnose_by_command, run_set

        done = run_set(config.out, diagnose_by_command, console, workers=workers)
        console.say(f"diagnosed: {counted(done, 'case')}; score them with `suite blind score`")
        return {"diagnosed": done, "out": str(config.out)}
    from suite.blind.score import not_run, report, score_set, shares

    verdicts = score_set(config.out)
    console.say(report(config.out, verdicts))
    return {
        "out": str(config.out),
        "shares": plain(shares(verdicts)),
        "not_run": not_run(config.out, verdicts),
        "cases": plain(verdicts),
    }


def _plan(config: Config, console: Console) -> dict[str, Any]:
    """Print flights that separate `config.effects`, and return the flights for --json."""
    from eval.effects import EFFECTS
    from suite.diagnose.plan import plan_for, separations_of

    names = [EFFECTS.find(name).name for name in config.effects]
    if len({*names}) < 2:
        given = ", ".join(names) or "empty"
        raise ValueError(f"--effects is {given}; give at least two different names of effects")
    for entry in separations_of(names):
        console.say(f"{' or '.join(entry.pair)}: {entry.words}")
    flights = plan_for(names)
    for flight in flights:
        yaw = f"yaw {flight.turn}"
        console.say(f"  {flight.kind}, {flight.duration_s:g} s, to {flight.speed:g} m/s, {yaw}")
    return {"flights": plain(flights)}

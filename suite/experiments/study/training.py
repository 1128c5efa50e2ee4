"""Rows x training seeds, trained: what is there already is found by its configuration's hash.

The run's folder is named by the configuration alone: code that has changed since does not start it
anew, so a document should say the commit of each.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from suite.common import curve
from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.common.running.apart import Job
from suite.common.stages import Estimate, announce
from suite.common.work import all_done
from suite.experiments.study.cache import digest
from suite.train.config import TrainConfig
from suite.train.ppo.config import PpoConfig
from tracks.common.names import unknown_name
from tracks.common.work import Workers

if TYPE_CHECKING:
    from suite.train.rollout import Note


class Row(NamedTuple):
    """What is trained, from every seed."""

    key: str
    """Its name."""
    words: str
    """What tables call it."""
    recipe: Any
    """A `TrainConfig` or a `PpoConfig`, with the seed left as it is."""


class Looks(NamedTuple):
    """How policies are flown in worlds that no training has seen."""

    measurements: int
    """About how many during a training; 0 for one, of the finished policy."""
    trials: int
    seed: int
    """Of the worlds."""
    seconds: float
    """Of a trial, from standing start."""


class Trained(NamedTuple):
    """One training of a row."""

    row: str
    """Its key."""
    seed: int
    policy: str
    """The checkpoint's folder; where the training diverged, its last finite one."""
    seconds: float
    """Spent on gradient steps after those that compile [s]."""
    compile_s: float
    """What those that compile took longer than the others [s]."""
    commit: str
    """That trained it; several, where it was stopped and gone on with."""
    diverged: str
    """What was said where it diverged, else ""."""
    points: list[dict[str, float]]
    """Numbers in unseen worlds. Those on the way have `steps`, the environment steps until then,
    and `time`, the seconds of training until then, without measurements and compilation."""


@dataclass(frozen=True)
class Study:
    """What is trained, how often, and how it is looked at."""

    rows: Sequence[Row]
    seeds: Sequence[int]
    looks: Looks | None = None
    """Flights in unseen worlds of the training's dynamics; None flies none."""
    by_seed: bool = False
    """Whether the rows take turns, so that they meet the same load of the machine."""
    may_diverge: bool = True
    """Whether the others go on where a training diverges."""
    start: str | None = None
    """The policy that all are trained on from, a shipped name or a checkpoint's folder; None:
    from nothing. Not for PPO."""

    def pieces(self) -> list[tuple[str, Any]]:
        """Return key and whole configuration of every training, in the order they are done."""
        if self.by_seed:
            return [(r.key, replace(r.recipe, seed=s)) for s in self.seeds for r in self.rows]
        return [(r.key, replace(r.recipe, seed=s)) for r in self.rows for s in self.seeds]


def asked_rows(rows: Sequence[Row], only: Sequence[str], what: str) -> list[Row]:
    """Return the rows whose keys are in `only`, all where it is empty.

    Raises:
        ValueError: for a key that no row has; `what` says what a row is.
    """
    names = [row.key for row in rows]
    for name in only:
        if name not in names:
            raise unknown_name(what, name, names)
    return [row for row in rows if not only or row.key in only]


def trained(
    study: Study, cache: Path, console: Console, workers: Workers | None = None
) -> list[Trained]:
    """Return every training of `study`; it is done, or gone on with, where missing.

    Args:
        study: what is trained.
        cache: where trainings are found again.
        console: where progress goes.
        workers: who trains; None or 1 does one training after the other on all cores.

    Raises:
        WorkFailed: where one diverges that may not.
    """
    from suite.judging.flying import checkpoint_folder
    from suite.train.ppo.run import estimate as ppo_estimate
    from suite.train.run import estimate

    pieces = study.pieces()
    if not pieces:
        return []
    needs = [ppo_estimate(c) if isinstance(c, PpoConfig) else estimate(c) for _, c in pieces]
    memory = max(need.memory_bytes for need in needs)
    memory *= workers if isinstance(workers, int) else 1
    whole = Estimate(sum(need.seconds for need in needs), memory)
    announce(console, f"{len(pieces)} trainings, less those that are there", whole)
    do = functools.partial(train_one, looks=study.looks, may_diverge=study.may_diverge)
    start = None if study.start is None else checkpoint_folder(study.start, "--init-from")
    jobs = [Job(piece, cache / _place_of(piece, study), start) for piece in pieces]
    ended = all_done(do, jobs, workers, console, "training")
    return [_read(job, *end) for job, end in zip(jobs, ended, strict=True)]


def _place_of(piece: tuple[str, Any], study: Study) -> Path:
    """Return the folder of a training within the cache."""
    from suite.judging.content import policy_digest

    (key, config), looks = piece, study.looks
    if looks and looks.measurements:
        return Path("schemes", digest([key, config, looks]))
    if study.start is None:
        return Path("trainings", digest(config))
    return Path("trainings", digest([config, policy_digest(study.start)]))


def train_one(
    job: Job, console: Console, looks: Looks | None = None, may_diverge: bool = False
) -> tuple[str, list[dict[str, float]]]:
    """Train one of `Study.pieces` in the job's folder, or find it, and measure it as `looks` says.

    It starts from the checkpoint that the job reads, if it reads one.

    Returns:
        `Trained.diverged`, and what was measured of the finished policy alone.

    Raises:
        WorkFailed: where it diverges and may not.
    """
    from suite.experiments.study.validation import make_validation
    from suite.train.overrides import phase_configs
    from suite.train.ppo.run import train_ppo
    from suite.train.run import started_from, train
    from suite.train.training_loop import Watch

    (key, config), folder, watch = job.task, job.folder, None
    is_ppo, diverged = isinstance(config, PpoConfig), ""
    if looks and looks.measurements:
        shared = config.shared if is_ppo else phase_configs(config)[-1]
        iterations = config.iterations if is_ppo else config.optimizer.iterations
        measure = make_validation(shared, *looks[1:], rewarded(shared))
        watch = Watch(max(1, iterations // looks.measurements), measure)
    begin: dict[str, Any] = {}
    if job.reads is not None:
        begin = {"params": started_from(str(job.reads), config.spec)}
    try:
        (train_ppo if is_ppo else train)(config, folder, console, watch=watch, **begin)
    except WorkFailed as failure:
        if not may_diverge:
            raise
        diverged = str(failure)
        console.note(f"{key}, seed {config.seed}: {diverged}")
    points = []
    if looks and not (watch or diverged):
        last = phase_configs(config)[-1]
        params = started_from(str(folder / "policy"), last.spec)
        found = make_validation(last, *looks[1:])(params)
        points = [found]
        console.note(
            f"{key}, seed {config.seed}: success cross {found['success_cross']:.0%}, "
            f"collision-free {found['collision_free']:.0%}, v_max {found['v_max']:.1f} m/s"
        )
    return diverged, points


def _read(job: Job, diverged: str, found: list[dict[str, float]]) -> Trained:
    """Return a training from its folder."""
    (key, config), policy = job.task, job.folder / "policy"
    points, compile_s = curve_of(job.folder, config.episode.batch * config.episode.steps)
    about = (str(policy), seconds_of(policy), compile_s, commit_of(policy))
    return Trained(key, config.seed, *about, diverged, found or points)


def rewarded(config: TrainConfig) -> Note:
    """Return the paper's reward, noted at every step of the rollout."""
    from suite.train.ppo.reward import make_reward

    reward = make_reward(config)
    return lambda worlds, before, body, target: reward(worlds, before, body, target)[0].total()


def curve_of(folder: Path, frames: int) -> tuple[list[dict[str, float]], float]:
    """Return a run's measurements with their steps and time, and what compilation took [s].

    Iterations that compile, the first and those after a stop, count as long as the median of the
    others.

    Args:
        folder: of the run.
        frames: environment steps in an iteration.
    """
    rows = curve.read(folder)
    warm = [row["seconds"] for row in rows if not row["cold"]]
    usual = float(np.median(warm)) if warm else 0.0
    spent = np.cumsum([0.0, *(usual if row["cold"] else row["seconds"] for row in rows)])
    compiling = sum(max(0.0, row["seconds"] - usual) for row in rows if row["cold"])
    points = []
    for point in curve.read(folder, curve.WATCHED):
        done = point.pop("iteration")
        points.append({"steps": done * frames, "time": float(spent[done]), **point})
    return points, compiling


def seconds_of(policy: Path) -> float:
    """Return how long `policy` (RUN/policy) was trained, without steps that compiled [s]."""
    return sum(row["seconds"] for row in curve.read(policy.parent) if not row["cold"])


def commit_of(policy: Path) -> str:
    """Return the commit that trained `policy` (RUN/policy), "unknown" where nothing says so.

    A training that was stopped and gone on with may have several: all of them.
    """
    path = policy.parent / "run.json"
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        return ", ".join([*record.get("earlier_commits", []), record["git_commit"] or "unknown"])
    except (OSError, ValueError, KeyError):
        return "unknown"


def facts(config: Any, runs: Sequence[Trained]) -> dict[str, str]:
    """Return what a page says of trainings that flew unseen worlds: seeds, commits, worlds."""
    return {
        "training seeds": " ".join(map(str, config.training_seeds)),
        "trained at commit": commits(runs),
        "unseen worlds": f"{config.trials}, seed {config.seed}, {config.seconds:g} s each",
    }


def commits(runs: Sequence[Trained]) -> str:
    """Return the commits of all trainings, each once."""
    return ", ".join(sorted({run.commit for run in runs}))

"""Settings x training seeds, trained; a finished training is reused.

A run's folder is named by the hash of its configuration. Newer code does not train it again, so
pages name the commit of each training.
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
from suite.experiments.study.cache import Place, digest
from suite.train.config import TrainConfig
from suite.train.ppo.config import PpoConfig

if TYPE_CHECKING:
    from suite.train.rollout import Note


class Row(NamedTuple):
    """A setting that is trained from every seed."""

    key: str
    """Its name."""
    words: str
    """Its label in tables."""
    recipe: Any
    """A `TrainConfig` or a `PpoConfig`; its seed is replaced."""


class Unseen(NamedTuple):
    """Measurement of policies in worlds that no training has seen."""

    measurements: int
    """About how many during a training; 0 measures only the finished policy."""
    trials: int
    seed: int
    """Seed of the worlds."""
    seconds: float
    """Length of a trial, from a standing start [s]."""


class Trained(NamedTuple):
    """One training of a setting."""

    row: str
    """The setting's key."""
    seed: int
    policy: str
    """The checkpoint's folder; of a diverged training the last finite checkpoint."""
    seconds: float
    """Time of the gradient steps that do not compile [s]."""
    compile_s: float
    """Extra time of the gradient steps that compile [s]."""
    commit: str
    """Commits of the code that trained it; several if it was resumed."""
    diverged: str
    """The message if it diverged, else ""."""
    points: list[dict[str, float]]
    """Measurements in unseen worlds. Those during the training have `steps`, the environment steps
    before, and `time`, the seconds of training before, without measurements and compilation."""


@dataclass(frozen=True)
class Study:
    """Settings, training seeds and measurement."""

    rows: Sequence[Row]
    seeds: Sequence[int]
    unseen: Unseen
    """Flights in the dynamics of the training."""
    by_seed: bool = False
    """Whether the settings alternate, so that all see the same load of the machine."""

    def pieces(self) -> list[tuple[str, Any]]:
        """Return key and configuration of every training, in the order of the work."""
        if self.by_seed:
            return [(r.key, replace(r.recipe, seed=s)) for s in self.seeds for r in self.rows]
        return [(r.key, replace(r.recipe, seed=s)) for r in self.rows for s in self.seeds]


def trained(study: Study, place: Place, console: Console) -> list[Trained]:
    """Return every training of `study`; missing ones are trained or resumed first.

    If one diverges, the others continue.

    Args:
        study: settings and seeds.
        place: cache of trainings, and workers; with at most one worker the trainings follow each
            other on all cores.
        console: shows progress.
    """
    from suite.train.ppo.update import estimate as ppo_estimate
    from suite.train.run import estimate

    pieces = study.pieces()
    if not pieces:
        return []
    needs = [ppo_estimate(c) if isinstance(c, PpoConfig) else estimate(c) for _, c in pieces]
    memory = max(need.memory_bytes for need in needs)
    memory *= place.workers if isinstance(place.workers, int) else 1
    whole = Estimate(sum(need.seconds for need in needs), memory)
    announce(console, f"{len(pieces)} trainings, less those that are there", whole)
    jobs = [Job(piece, place.cache / _folder_of(piece, study.unseen)) for piece in pieces]
    do = functools.partial(train_one, unseen=study.unseen)
    ended = all_done(do, jobs, place.workers, console, "training")
    return [_read(job, *end) for job, end in zip(jobs, ended, strict=True)]


def _folder_of(piece: tuple[str, Any], unseen: Unseen) -> Path:
    """Return the folder of a training within the cache."""
    key, config = piece
    if unseen.measurements:
        return Path("schemes", digest([key, config, unseen]))
    return Path("trainings", digest(config))


def train_one(job: Job, console: Console, unseen: Unseen) -> tuple[str, list[dict[str, float]]]:
    """Train one of `Study.pieces` in the job's folder unless it is finished, and measure it.

    Returns:
        `Trained.diverged`, and the measurement of the finished policy, if only that is measured.
    """
    from suite.experiments.study.validation import make_validation
    from suite.train.overrides import phase_configs
    from suite.train.ppo.update import train_ppo
    from suite.train.run import started_from, train
    from suite.train.training_loop import Watch

    (key, config), folder, watch = job.task, job.folder, None
    is_ppo = isinstance(config, PpoConfig)
    if unseen.measurements:
        shared = config.shared if is_ppo else phase_configs(config)[-1]
        iterations = config.iterations if is_ppo else config.optimizer.iterations
        measure = make_validation(shared, *unseen[1:], rewarded(shared))
        watch = Watch(max(1, iterations // unseen.measurements), measure)
    try:
        (train_ppo if is_ppo else train)(config, folder, console, watch=watch)
    except WorkFailed as failure:
        console.note(f"{key}, seed {config.seed}: {failure}")
        return str(failure), []
    if watch:
        return "", []
    last = phase_configs(config)[-1]
    params = started_from(str(folder / "policy"), last.spec)
    found = make_validation(last, *unseen[1:])(params)
    console.note(
        f"{key}, seed {config.seed}: success cross {found['success_cross']:.0%}, "
        f"collision-free {found['collision_free']:.0%}, v_max {found['v_max']:.1f} m/s"
    )
    return "", [found]


def _read(job: Job, diverged: str, found: list[dict[str, float]]) -> Trained:
    """Return a training from its folder."""
    (key, config), policy = job.task, job.folder / "policy"
    points, compile_s = curve_of(job.folder, config.episode.batch * config.episode.steps)
    rows = curve.read(job.folder)
    seconds = sum(row["seconds"] for row in rows if not row["cold"])
    about = (str(policy), seconds, compile_s, commit_of(policy))
    return Trained(key, config.seed, *about, diverged, found or points)


def rewarded(config: TrainConfig) -> Note:
    """Return a function that records the paper's reward at every step of a rollout."""
    from suite.train.ppo.reward import make_reward

    reward = make_reward(config)
    return lambda worlds, before, body, target: reward(worlds, before, body, target)[0].total()


def curve_of(folder: Path, frames: int) -> tuple[list[dict[str, float]], float]:
    """Return a run's measurements with their steps and time, and the time of compilation [s].

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


def commit_of(policy: Path) -> str:
    """Return the commit that trained `policy` (RUN/policy), or "unknown".

    A training that was interrupted and resumed may have several commits; all are returned.
    """
    path = policy.parent / "run.json"
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
        return ", ".join([*record.get("earlier_commits", []), record["git_commit"] or "unknown"])
    except (OSError, ValueError, KeyError):
        return "unknown"


def facts(config: Any, runs: Sequence[Trained]) -> dict[str, str]:
    """Return the facts of a page on trainings: seeds, commits, unseen worlds."""
    return {
        "training seeds": " ".join(map(str, config.training_seeds)),
        "trained at commit": ", ".join(sorted({run.commit for run in runs})),
        "unseen worlds": f"{config.trials}, seed {config.seed}, {config.seconds:g} s each",
    }

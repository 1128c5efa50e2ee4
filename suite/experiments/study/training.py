"""Train several settings from several seeds, measure the policies, and summarise over the seeds.

Finished trainings are reused. Their folder is named by the hash of the configuration, which a
change of the code does not change. Therefore pages name the commit of each training.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from suite.common import curve
from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.common.running.remote import Job
from suite.common.stages import Estimate, announce
from suite.common.work import do_jobs
from suite.experiments.study.cache import Workspace, digest
from suite.train.config import TrainConfig
from suite.train.ppo.config import PpoConfig

if TYPE_CHECKING:
    from suite.train.rollout import Note


class Setting(NamedTuple):
    """One of the compared configurations, which is trained from every seed."""

    key: str
    label: str
    """Label of the setting in tables."""
    recipe: Any
    """The configuration, a `TrainConfig` or a `PpoConfig`; each training replaces its seed."""


class UnseenWorlds(NamedTuple):
    """Measurement of policies in worlds (scenes with a drone) that no training uses."""

    measurements: int
    """Approximate number of measurements during a training; 0 measures only the finished policy."""
    trials: int
    """Number of worlds."""
    seed: int
    seconds: float
    """Length of a trial, from a standing start [s]."""


class TrainingResult(NamedTuple):
    """One training of a setting."""

    setting: str
    """Key of the setting."""
    seed: int
    seconds: float
    """Time of the gradient steps that do not compile [s]."""
    compile_s: float
    """Extra time of the gradient steps that compile [s]."""
    commit: str
    """Commit of the code that trained it; several commits if the training was resumed."""
    machine: str
    """Processor that trained it last, and the number of its cores that were used."""
    diverged: str
    """The error message if the training diverged, else ""."""
    points: list[dict[str, float]]
    """Measurements in unseen worlds, each a dictionary of measures. One that was made during the
    training also has `steps` and `time`: the environment steps until then, and the time of training
    until then, without measurements and compilation [s]."""


def train_all(
    settings: Sequence[Setting],
    seeds: Sequence[int],
    unseen: UnseenWorlds,
    workspace: Workspace,
    console: Console,
    by_seed: bool = False,
) -> list[TrainingResult]:
    """Return the trainings of all settings from all seeds; missing ones are made or resumed first.

    If a training diverges, the others continue. With at most one worker the trainings run one after
    the other on all cores. With `by_seed`, all settings are trained from the first seed, then from
    the second, and so on. Times can then be compared, because a changing load of the machine
    affects all settings alike.
    """
    from suite.train.ppo.update import estimate as ppo_estimate
    from suite.train.run import estimate

    pieces = [(each.key, replace(each.recipe, seed=seed)) for each in settings for seed in seeds]
    if by_seed:
        pieces = [piece for first in range(len(seeds)) for piece in pieces[first :: len(seeds)]]
    if not pieces:
        return []
    estimates = [ppo_estimate(c) if isinstance(c, PpoConfig) else estimate(c) for _, c in pieces]
    # Memory for as many trainings as run at once on this machine.
    memory = max(each.memory_bytes for each in estimates)
    memory *= workspace.workers if isinstance(workspace.workers, int) else 1
    total = Estimate(sum(each.seconds for each in estimates), memory)
    announce(console, f"{len(pieces)} trainings, of which finished ones are reused", total)
    # Measurements during a training are in its folder, so they are a part of the folder's name.
    folders = [
        Path("schemes", digest([key, config, unseen]))
        if unseen.measurements
        else Path("trainings", digest(config))
        for key, config in pieces
    ]
    jobs = [Job(each, workspace.cache / name) for each, name in zip(pieces, folders, strict=True)]
    do = functools.partial(train_setting, unseen=unseen)
    results = do_jobs(do, jobs, workspace.workers, console, "training")
    return [_finished_training(job, *result) for job, result in zip(jobs, results, strict=True)]


def train_setting(
    job: Job, console: Console, unseen: UnseenWorlds
) -> tuple[str, list[dict[str, float]]]:
    """Train a job (key of a setting, configuration) in its folder, and measure the policy.

    Returns:
        The error message if it diverged, else ""; and the measurement of the finished policy, as a
        list of one entry. The list is empty if the policy was measured during the training.
    """
    from policies.formats.policy_file import load_policy_checkpoint
    from suite.experiments.study.validation import make_validation
    from suite.train.overrides import phase_configs
    from suite.train.ppo.update import train_ppo
    from suite.train.run import start_params, train
    from suite.train.training_loop import Watch

    (key, config), folder, watch = job.task, job.folder, None
    is_ppo = isinstance(config, PpoConfig)
    if unseen.measurements:
        shared = config.shared if is_ppo else phase_configs(config)[-1]
        iterations = config.iterations if is_ppo else config.optimizer.iterations
        measure = make_validation(shared, *unseen[1:], reward_recorder(shared))
        watch = Watch(max(1, iterations // unseen.measurements), measure)
    try:
        (train_ppo if is_ppo else train)(config, folder, console, watch=watch)
    except WorkFailed as failure:
        console.note(f"{key}, seed {config.seed}: {failure}")
        return str(failure), []
    if watch:  # the measurements are in the folder
        return "", []
    last = phase_configs(config)[-1]
    params = start_params(load_policy_checkpoint(folder / "policy"), last.spec)
    scores = make_validation(last, *unseen[1:])(params)
    console.note(
        f"{key}, seed {config.seed}: success cross {scores['success_cross']:.0%}, "
        f"collision-free {scores['collision_free']:.0%}, v_max {scores['v_max']:.1f} m/s"
    )
    return "", [scores]


def _finished_training(job: Job, diverged: str, at_end: list[dict[str, float]]) -> TrainingResult:
    """Return a training from its folder.

    `at_end` has the measurement of the finished policy, or is empty if the folder has measurements.
    """
    key, config = job.task
    commit, machine = training_origin(job.folder)
    points, compile_s = read_measurements(job.folder, config.episode.batch * config.episode.steps)
    rows = curve.read(job.folder)
    return TrainingResult(
        setting=key,
        seed=config.seed,
        seconds=sum(row["seconds"] for row in rows if not row["cold"]),
        compile_s=compile_s,
        commit=commit,
        machine=machine,
        diverged=diverged,
        points=at_end or points,
    )


def reward_recorder(config: TrainConfig) -> Note:
    """Return a function that gives the paper's reward of each step, for the record of a rollout."""
    from suite.train.ppo.reward import make_reward

    reward = make_reward(config)
    return lambda worlds, before, body, target: reward(worlds, before, body, target)[0].total()


def read_measurements(folder: Path, frames: int) -> tuple[list[dict[str, float]], float]:
    """Return the measurements of a run, each with its `steps` and `time`, and the compile time [s].

    Some iterations compile ("cold": the first one, and the first after a stop). They count with the
    median time of the others. An iteration has `frames` environment steps.
    """
    rows = curve.read(folder)
    warm = [row["seconds"] for row in rows if not row["cold"]]
    median_s = float(np.median(warm)) if warm else 0.0
    time_s = np.cumsum([0.0, *(median_s if row["cold"] else row["seconds"] for row in rows)])
    compile_s = sum(max(0.0, row["seconds"] - median_s) for row in rows if row["cold"])
    points = []
    for point in curve.read(folder, curve.WATCHED):
        iteration = point.pop("iteration")
        points.append({"steps": iteration * frames, "time": float(time_s[iteration]), **point})
    return points, compile_s


def training_origin(folder: Path) -> tuple[str, str]:
    """Return the commit of the code that made the training in `folder`, and the machine.

    A training that was interrupted and resumed may have several commits; the text has all of them.
    Both are "unknown" without a record.
    """
    try:
        record = json.loads((folder / "run.json").read_text(encoding="utf-8"))
        commits = [
            *record.get("earlier", {}).get("git_commit", []),
            record["git_commit"] or "unknown",
        ]
        cores, processor = record["machine"]["cores"], record["machine"]["processor"]
        return ", ".join(commits), f"{processor}, cores: {cores}"
    except (OSError, ValueError, KeyError):
        return "unknown", "unknown"


def facts(config: Any, runs: Sequence[TrainingResult]) -> dict[str, str]:
    """Return the facts of a page on trainings: seeds, commits, machines, unseen worlds."""
    return {
        "training seeds": " ".join(map(str, config.training_seeds)),
        "trained at commit": ", ".join(sorted({run.commit for run in runs})),
        "each trained on": "; ".join(sorted({run.machine for run in runs})),
        "unseen worlds": f"{config.trials}, seed {config.seed}, {config.seconds:g} s each",
    }


class Spread(NamedTuple):
    """The values of one measure, such as `v_max`, over the training seeds."""

    mean: float
    least: float
    most: float


class Summary(NamedTuple):
    """One setting over its training seeds; diverged trainings are left out of all numbers."""

    key: str
    label: str
    recipe: Any
    """The trained configuration, a `TrainConfig` or a `PpoConfig`."""
    seeds: int
    """Number of trainings, including diverged ones."""
    trainings: list[list[dict[str, float]]]
    """Measurements of every training that did not diverge, in the order of time; a measurement
    is a dictionary of measures."""
    at: list[dict[str, Spread]]
    """The spread of every measure over the seeds, at each measurement; empty if all diverged."""

    @property
    def diverged(self) -> int:
        """Number of trainings that diverged."""
        return self.seeds - len(self.trainings)

    def values(self, name: str) -> list[float]:
        """Return a measure at the end of each training, without diverged ones."""
        return [points[-1][name] for points in self.trainings]

    def text(self, name: str) -> str:
        """Return a measure at the end as text for a table: mean over seeds [least, most]."""
        if not self.at:
            return "diverged"
        _, scale, digits = curve.METRICS[name]
        mean, least, most = (f"{scale * value:.{digits}f}" for value in self.at[-1][name])
        return f"{mean} [{least}, {most}]"


def summaries(settings: Sequence[Setting], runs: Sequence[TrainingResult]) -> list[Summary]:
    """Return the summary of every setting, in order."""
    result = []
    for key, label, recipe in settings:
        setting_runs = [run for run in runs if run.setting == key]
        trainings = [run.points for run in setting_runs if not run.diverged]
        at = [
            {name: _spread([point[name] for point in seeds]) for name in seeds[0]}
            for seeds in zip(*trainings, strict=True)
        ]
        result.append(Summary(key, label, recipe, len(setting_runs), trainings, at))
    return result


def _spread(values: Sequence[float]) -> Spread:
    return Spread(float(np.mean(values)), min(values), max(values))

"""The paper's comparison of training schemes: PPO, ours, and ours without the vector field."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

from suite.common.choices import at_least
from suite.common.console import Console
from suite.experiments.recipes import (
    FourGates,
    asked_rows,
    check_owned,
    check_sizes,
    four_gate_recipe,
)

if TYPE_CHECKING:
    from pathlib import Path

    from suite.experiments.document import Place
    from suite.train.config import TrainConfig
    from suite.train.ppo.config import PpoConfig

PROJECTION, PROJECTION_DECAY = 3.0, 0.5
"""lambda_proj and beta_3 of the paper's scheme without the field."""


@dataclass(frozen=True)
class Config(FourGates):
    """Train by PPO, by our method, and by it without the field, and measure them as they learn.

    All three share policy, dynamics, worlds and the number of environment steps. Trainings are
    found again by the hash of their configuration and of what is measured on the way.
    """

    progress: float = 0.4
    """lambda_p of both differentiable schemes; the paper's."""
    ppo_iterations: int | None = None
    """Rollouts of PPO; as many as the others' gradient steps if not given."""
    trials: int = 100
    """Unseen worlds that are flown at every measurement."""
    measurements: int = 20
    """About how many a training has; their time is no part of the curves."""
    only: tuple[str, ...] = ()
    """Schemes: ppo, ours, projection; all if none is named."""
    jobs: int = 1
    """Trainings at once, each in a process with its own share of the cores; the curves over time
    are those of such a share."""


class Scheme(NamedTuple):
    """How a policy is trained."""

    key: str
    """Its name."""
    words: str
    """What tables call it."""
    recipe: TrainConfig | PpoConfig
    """With the seed left as it is."""


class Looks(NamedTuple):
    """What is measured during a training."""

    measurements: int
    trials: int
    seed: int
    seconds: float


class Learnt(NamedTuple):
    """One training and its curve."""

    scheme: str
    seed: int
    points: list[dict[str, float]]
    """Measurements with `steps`, the environment steps until then, and `time`, the seconds of
    training until then, without measurements and compilation."""
    compile_s: float
    """What the first iteration took longer than the others [s]."""
    commit: str
    """That trained it."""
    diverged: str = ""
    """What was said where the training diverged."""


def run(config: Config, place: Place, console: Console) -> dict[str, Any]:
    """Train what is missing and write schemes.md.

    Raises:
        ValueError: for anything that cannot be used, before the first training.
    """
    import functools

    from suite.common.work import all_done, check_jobs
    from suite.experiments.document import write_document
    from suite.experiments.scheme_curves import summaries
    from suite.experiments.scheme_tables import scheme_report

    check_sizes(config)
    check_jobs(config.jobs)
    at_least("--measurements", config.measurements, 1)
    chosen = schemes(config)
    # Seed by seed, so that the schemes meet the same load where the machine has another.
    runs = [
        (scheme.key, replace(scheme.recipe, seed=seed))
        for seed in config.training_seeds
        for scheme in chosen
    ]
    looks = Looks(config.measurements, config.trials, config.seed, config.seconds)
    do = functools.partial(learn, cache=place.cache, looks=looks)
    console.note(f"{len(runs)} trainings, less those that are there")
    results = all_done(do, runs, config.jobs, console, "training")
    rows = summaries(chosen, results)
    report = scheme_report(config, chosen, rows, results)
    numbers = {"config": config, "rows": rows, "runs": results}
    return write_document(place, "schemes", report, numbers, config.seed, console)


def schemes(config: Config) -> list[Scheme]:
    """Return the schemes that are asked for, in the paper's order.

    Raises:
        ValueError: for a preset, a change or a scheme that does not exist, and for worlds that PPO
            cannot share among its minibatches.
    """
    from suite.train.ppo.config import ppo_like

    compared = ("progress_norm", "projection", "projection_decay")
    owned = {f"loss.{name}": "it is compared" for name in compared}
    check_owned(config.set, {"loss.progress": "give --progress", **owned})
    base = four_gate_recipe(config)
    loss = replace(base.loss, progress=config.progress, progress_norm=0.0, projection=0.0)
    ours = replace(base, loss=loss)
    scalar = replace(loss, field_gain=0.0, projection=PROJECTION, projection_decay=PROJECTION_DECAY)
    ppo = ppo_like(ours, config.ppo_iterations or ours.optimizer.iterations)
    rows = [
        Scheme("ppo", "PPO", ppo),
        Scheme("ours", "ours", ours),
        Scheme("projection", "ours without the field, with L_proj", replace(base, loss=scalar)),
    ]
    rows = asked_rows(rows, config.only, "scheme")
    if ppo.episode.batch % ppo.minibatches and "ppo" in [row.key for row in rows]:
        raise ValueError(
            f"--worlds is {ppo.episode.batch}, allowed with PPO are multiples of its "
            f"{ppo.minibatches} minibatches"
        )
    return rows


def learn(
    run: tuple[str, TrainConfig | PpoConfig], console: Console, cache: Path, looks: Looks
) -> Learnt:
    """Train one run, or find it, and return its curve.

    Args:
        run: the scheme's key and the whole configuration.
        console: where progress goes.
        cache: folder of all runs.
        looks: what is measured on the way.
    """
    from suite.common.errors import WorkFailed
    from suite.experiments.cache import digest
    from suite.experiments.trainings import commit_of
    from suite.experiments.validation import make_validation
    from suite.train.ppo.config import PpoConfig
    from suite.train.ppo.run import train_ppo
    from suite.train.repeat import Watch
    from suite.train.run import train

    key, config = run
    is_ppo = isinstance(config, PpoConfig)
    shared = config.shared if is_ppo else config
    iterations = config.iterations if is_ppo else config.optimizer.iterations
    measure = make_validation(shared, looks.trials, looks.seed, looks.seconds, rewarded(shared))
    watch = Watch(max(1, iterations // looks.measurements), measure)
    folder = cache / "schemes" / digest([key, config, looks])
    diverged = ""
    try:
        if is_ppo:
            train_ppo(config, folder, console, watch)
        else:
            train(config, folder, console, watch=watch)
    except WorkFailed as failure:
        diverged = str(failure)
        console.note(f"{key}, seed {config.seed}: {diverged}")
    frames = config.episode.batch * config.episode.steps
    points, compile_s = curve_of(folder, frames)
    return Learnt(key, config.seed, points, compile_s, commit_of(folder / "policy"), diverged)


def rewarded(config: TrainConfig) -> Any:
    """Return the paper's reward as a `Note` of the rollout."""
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
    import numpy as np

    from suite.train import curve

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

"""The paper's ablation: with the Attractive Vector Field and without it, at several weights."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

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

PROGRESS = (0.4, 0.8, 1.6, 3.2)
"""lambda_p of L_p. The paper has the field at the first alone; here it is on and off at each and at
the recipe's own weight, so that a pair differs in the field and in nothing else."""
NORMALISED = (1.6, 3.2, 6.4)
"""lambda_p of L_p^norm without the field."""


@dataclass(frozen=True)
class Config(FourGates):
    """Train with the vector field and without it, from several seeds, and fly unseen worlds.

    Trainings are found again by the hash of their configuration.
    """

    only: tuple[str, ...] = ()
    """Settings, such as "field 0.4"; all if none is named."""
    jobs: int = 1
    """Trainings at once, each in a process with its own share of the cores."""


class Setting(NamedTuple):
    """One row: what is trained."""

    key: str
    """Its name, that of the paper's row where there is one."""
    words: str
    """What tables call it."""
    weight: float
    """lambda_p."""
    recipe: TrainConfig
    """With the seed left as it is."""


class Trained(NamedTuple):
    """One training run of a setting, measured."""

    setting: str
    seed: int
    seconds: float
    """Spent on gradient steps after the first, which compiles [s]."""
    commit: str
    """That trained it."""
    measured: dict[str, float] | None
    """Numbers of `validation.py`; None where the training diverged."""
    diverged: str = ""
    """What was said then."""


def run(config: Config, place: Place, console: Console) -> dict[str, Any]:
    """Train and fly what is missing and write ablation.md.

    Raises:
        ValueError: for anything that cannot be used, before the first training.
    """
    import functools

    from suite.common.estimate import Estimate, announce
    from suite.common.work import all_done, check_jobs
    from suite.experiments.ablation_tables import ablation_report, summaries
    from suite.experiments.document import write_document
    from suite.train.run import estimate

    check_sizes(config)
    check_jobs(config.jobs)
    chosen = settings(config)
    runs = [
        (setting.key, replace(setting.recipe, seed=seed))
        for setting in chosen
        for seed in config.training_seeds
    ]
    needs = [estimate(recipe) for _, recipe in runs]
    memory = config.jobs * max(need.memory_bytes for need in needs)
    whole = Estimate(sum(need.seconds for need in needs), memory)
    announce(console, f"{len(runs)} trainings, less those that are there", whole)
    trials = (config.trials, config.seed, config.seconds)
    do = functools.partial(train_and_measure, cache=place.cache, trials=trials)
    results = all_done(do, runs, config.jobs, console, "training")
    rows = summaries(chosen, results, config.trials)
    report = ablation_report(config, chosen, rows, results)
    numbers = {"config": config, "rows": rows, "runs": results}
    return write_document(place, "ablation", report, numbers, config.seed, console)


def settings(config: Config) -> list[Setting]:
    """Return the rows that are asked for, in the paper's order.

    Raises:
        ValueError: for a preset, a change or a row that does not exist.
    """
    fixed = ("progress_norm", "projection")
    check_owned(config.set, {f"loss.{name}": "it is compared" for name in fixed})
    base = four_gate_recipe(config)

    def row(key: str, words: str, weight: float, **changes: float) -> Setting:
        recipe = replace(base, loss=replace(base.loss, **changes))
        return Setting(f"{key} {weight:g}", words, weight, recipe)

    bare = {"field_gain": 0.0}
    weights = sorted({float(f"{weight:g}") for weight in (*PROGRESS, base.loss.progress)})
    rows = [row("field", "with the field, L_p", w, progress=w, progress_norm=0.0) for w in weights]
    rows += [
        row("progress", "without, L_p", w, progress=w, progress_norm=0.0, **bare) for w in weights
    ]
    rows += [
        row("normalised", "without, L_p^norm", w, progress=0.0, progress_norm=w, **bare)
        for w in NORMALISED
    ]
    return asked_rows(rows, config.only, "setting")


def train_and_measure(
    run: tuple[str, TrainConfig],
    console: Console,
    cache: Path,
    trials: tuple[int, int, float],
) -> Trained:
    """Train one run, or find it, and fly its policy.

    Args:
        run: the setting's key and the whole configuration.
        console: where progress goes.
        cache: folder of all runs.
        trials: how many, the seed of their worlds, and the seconds of each.
    """
    from suite.experiments.trainings import commit_of, divergence, folder_of, warm_seconds
    from suite.experiments.validation import make_validation, stored_params

    key, config = run
    diverged = divergence(config, cache, console)
    folder = folder_of(config, cache)
    seconds, commit = warm_seconds(folder), commit_of(folder / "policy")
    about = Trained(key, config.seed, seconds, commit, None, diverged)
    if diverged:
        console.note(f"{key}, seed {config.seed}: {diverged}")
        return about
    measured = make_validation(config, *trials)(stored_params(folder / "policy"))
    console.note(
        f"{key}, seed {config.seed}: success cross {measured['success_cross']:.0%}, "
        f"success rate {measured['success_rate']:.0%}, v_max {measured['v_max']:.1f} m/s"
    )
    return about._replace(measured=measured)

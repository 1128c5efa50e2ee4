"""What could be better than the paper's recipe: single changes and a few joined ones, judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np

from eval.judging.statistics import Interval
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import TrialResult
from suite.common.console import Console, duration
from suite.common.errors import WorkFailed
from suite.common.report import Picture, Report, Section, ranged
from suite.experiments.pages.document import Place
from suite.experiments.pages.tables import points_cell
from suite.experiments.schemes import PROJECTION, PROJECTION_DECAY
from suite.experiments.study import judging, options, training
from suite.experiments.study.intervals import WHAT_COUNTS, Gap, crossed, spread
from suite.experiments.study.summary import Summary, summaries
from suite.train.config import TrainConfig
from suite.train.config import check as check_recipe
from suite.train.overrides import override
from suite.train.presets import at_rate
from tracks.common.grid import Grid, table
from tracks.input.ranges import Iterations, Range, Seed, Trials

RECIPE = "recipe"
"""The key of the row that all others are compared with."""
ROUND_CORNERS = 8
"""Of the gates in the comparison of fields."""
MEANING = (
    "Success: over the trials of all training seeds, with the least and the most of a seed. "
    "Difference: to the recipe on the same trials and training seeds, in points, with a 95 % "
    "bootstrap interval that draws training seeds and trials anew. "
    f"{WHAT_COUNTS} Seeds are few, and all rows are compared with the same "
    "trainings of the recipe: where a change does nothing, three seeds agree in sign one time in "
    "four, and of many rows one may stand out by chance.",
    "v_max: the median over trials of each one's largest speed before any contact. Training: the "
    "median time of a row's trainings, without compilation.",
)
ROUND = (
    "In the training's own dynamics, from standing start. Success cross: all gates without a "
    "collision; success rate: no collision, whatever gates were passed. Mean over training seeds, "
    "least and most. Images show the nearest 24 bars and plates, and collisions are looked for "
    "among the nearest 8: three gates and one, with eight bars each. It is the same for both."
)


@dataclass(frozen=True)
class Config:
    """Train a recipe and variants of it, with one change each or a few, and judge them in pairs.

    Round gates, which no judged track has, are flown in the training's own dynamics.
    """

    preset: str = "small"
    """The recipe."""
    set: tuple[str, ...] = ("episode.image_stride=3",)
    """Change settings of the recipe, and so of all rows, by name."""
    iterations: Iterations | None = None
    """Gradient steps, instead of the preset's."""
    training_seeds: tuple[Seed, ...] = (0, 1, 2)
    """Seeds that every row is trained from; less than three tell nothing."""
    difficulty: str = "0,3,6"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials = 10
    """Trials of every training on every track at every level, the same for all."""
    seed: Seed = 0
    """Seed of the first trial; the others follow by one."""
    round_trials: Trials = 300
    """Unseen worlds with round gates that each of their trainings flies."""
    round_seed: Seed = 1000
    """Of those worlds; none of the training seeds."""
    round_seconds: Annotated[float, Range(0.5, 3600.0)] = 20.0
    """Of a trial there, from standing start."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""
    only: tuple[str, ...] = ()
    """Rows besides the recipe's; all if none is named."""


class Compared(NamedTuple):
    """A row against the recipe."""

    key: str
    success: list[float]
    """Of each training seed."""
    difference: Interval
    """In success, over all seeds' trials."""
    of_seeds: list[float]
    """The difference of each training seed."""
    v_max: float
    """Median over trials [m/s]."""
    collisions: float
    """Share of trials."""
    timeouts: float
    """Share of trials."""
    seconds: float
    """Median training time [s]."""

    @property
    def gap(self) -> Gap:
        """The difference, and what it tells."""
        return Gap(self.difference, self.of_seeds)


def document(config: Config, place: Place, console: Console) -> tuple[Report, dict[str, Any]]:
    """Return the page and its numbers; train and fly what is missing.

    Raises:
        WorkFailed: where a training of the recipe itself diverges; any other leaves its row out.
    """
    from suite.experiments.pages.charts import gaps_chart

    seeds, vehicle = config.training_seeds, load_vehicle(config.vehicle)
    wanted, trials = ideas(config), judging.trials_of(config)
    refused = refused_rows(wanted, named=bool(config.only))
    asked = [row for row in wanted if row.key not in refused]
    looks = training.Looks(0, config.round_trials, config.round_seed, config.round_seconds)
    plain, turned = ([row for row in asked if is_round(row) is turn] for turn in (False, True))
    studies = [
        training.Study(plain, seeds, by_seed=True),
        training.Study(turned, seeds, looks),
    ]
    runs = [
        run
        for study in studies
        for run in training.trained(study, place.cache, console, place.workers)
    ]
    failures = _failures(runs)
    judged, rounds = ([r for r in study.rows if r.key not in failures] for study in studies)
    made = {(run.row, run.seed): run for run in runs}
    orders = {
        (row.key, seed): judging.Order(judging.Flier(made[row.key, seed].policy, vehicle), trials)
        for row in judged
        for seed in seeds
    }
    flights = judging.flown(
        orders, place.cache, console, f"judging {len(orders)} trainings", place.workers
    )
    base = _won([flights[RECIPE, seed] for seed in seeds])
    rows = [
        compared(
            row.key,
            [flights[row.key, seed] for seed in seeds],
            base,
            float(np.median([made[row.key, seed].seconds for seed in seeds])),
        )
        for row in judged
    ]
    measured, recipe = summaries(rounds, runs), asked[0].recipe
    caption = "Difference in success to the recipe; dots: training seeds."
    picture = Picture(gaps_chart({row.key: row.gap for row in rows[1:]}), caption)
    sections = [Section("Change by change", [_grid(judged, rows), *MEANING, picture])]
    if rounds:
        sections.append(Section("Round gates", [_round_grid(measured), ROUND]))
    report = Report(
        title="What could be better than the recipe",
        lead=" ".join([lead(rows), *map(_round_words, measured)]),
        facts={
            "recipe": f"{options.recipe_words(config)}, {recipe.optimizer.iterations} gradient "
            f"steps of {recipe.episode.batch} worlds x {recipe.episode.steps} steps",
            "training seeds": " ".join(map(str, seeds)),
            "trained at commit": training.commits(runs),
            "trials": f"three tracks, levels {config.difficulty}, seeds "
            f"{options.judged_seeds(config)}: {len(trials)} a training",
            "worlds with round gates": f"{config.round_trials}, seed {config.round_seed}, "
            f"{config.round_seconds:g} s each",
            "trainings at once": place.at_once,
            "vehicle": config.vehicle,
            **{f"left out, {key}": said for key, said in {**refused, **failures}.items()},
        },
        sections=sections,
    )
    worlds = {row.key: [points[-1] for points in row.whole] for row in measured}
    return report, {"rows": rows, "round": worlds, "diverged": failures}


def ideas(config: Config) -> list[training.Row]:
    """Return the recipe and the changes of it that are asked for; what changes nothing is left out.

    Raises:
        ValueError: for a preset, a change or a row that does not exist.
    """
    base = options.asked_recipe(config)
    if base.episode.gate_corners != 4:
        raise ValueError(
            f"--set episode.gate_corners={base.episode.gate_corners}: the judge's gates have 4; "
            "round gates have rows of their own"
        )
    longer = (
        f"episode.steps={2 * base.episode.steps}",
        f"episode.batch={max(1, base.episode.batch // 2)}",
    )
    fading = f"loss.gradient_decay={2 * base.loss.gradient_decay:g}"
    scalar = f"loss.projection={PROJECTION:g}", f"loss.projection_decay={PROJECTION_DECAY:g}"
    price = f"loss.survival={base.loss.progress:g}"
    thirds = f"episode.steps={base.episode.steps // 3}", f"episode.batch={3 * base.episode.batch}"
    value = (f"loss.value={base.loss.progress:g}",)
    live_on, again = "episode.live_on=0.7", "episode.again=0.5"
    sides = {"width": base.spec.camera.width, "height": base.spec.camera.height}
    finer = tuple(f"spec.camera.{side}={4 * (3 * n // 8)}" for side, n in sides.items())
    wider = (f"spec.hidden_size={5 * base.spec.hidden_size // 3}",)
    corners = f"episode.gate_corners={ROUND_CORNERS}"
    rows = {
        "second gate": ("the gate after the next is observed", ("spec.second_gate=True",)),
        "gate axis": ("the next gate's direction is observed", ("spec.gate_axis=True",)),
        "pass first": ("progress looks ahead at a gate", ("loss.pass_first=True",)),
        "finish": ("a world is done at its last gate", ("episode.finish=True",)),
        "heights": ("gates further up and down", ("episode.height_spread=2.0",)),
        "curriculum": ("difficulty grows over the first half", ("episode.easy_until=0.5",)),
        "one check": ("collision check at a step's end alone", ("loss.path_samples=1",)),
        "survival": ("a crash costs the progress after it", (price,)),
        "critic": ("a critic's value of what comes after", value),
        "short": ("a third of the horizon, three times the worlds", thirds),
        "short, critic": ("and a critic's value of what comes after", (*thirds, *value)),
        "short, critic, live on": (
            "and worlds go on from rollout to rollout",
            (*thirds, *value, live_on),
        ),
        "live on": ("worlds go on from rollout to rollout", (live_on,)),
        "again": ("crashed worlds go on from before the crash", (again,)),
        "often": (
            "twice the decisions, in as many seconds; a point mass is 2 late at most",
            twice_as_often(base),
        ),
        "finer image": ("half as many pixels again each way", finer),
        "wider memory": ("two thirds more units", wider),
        "longer": ("twice the horizon, half the worlds", longer),
        "longer, truncated": ("and gradients that fade twice as fast", (*longer, fading)),
        "L_proj": ("the scalar substitute in the field's place", ("loss.field_gain=0", *scalar)),
        "field and L_proj": ("both", scalar),
        "round": ("round gates with their own field", (corners,)),
        "round, square field": (
            "round gates with the field of the square around them",
            (corners, "loss.field_square=True"),
        ),
    }
    made = [
        training.Row(key, words, override(base, changes), changes)
        for key, (words, changes) in rows.items()
    ]
    kept = training.asked_rows(made, config.only, "row")
    recipe = training.Row(RECIPE, "nothing changed", base)
    return [recipe, *(row for row in kept if row.recipe != base)]


def twice_as_often(base: TrainConfig) -> tuple[str, ...]:
    """Return the changes by which `base` decides twice as often, with delays kept in seconds."""
    often = at_rate(base, 2 * base.spec.rate_hz)
    # Quadrotors have their delay in seconds already.
    own = () if base.quadrotor or base.fleet else ("action_delay",)
    parts = {
        "spec": ("rate_hz",),
        "physics": (*own, "state_delay", "image_delay"),
        "episode": ("steps", "image_stride"),
    }
    return tuple(
        f"{part}.{name}={getattr(getattr(often, part), name)}"
        for part, names in parts.items()
        for name in names
        if getattr(getattr(often, part), name) != getattr(getattr(base, part), name)
    )


def refused_rows(rows: Sequence[training.Row], named: bool) -> dict[str, str]:
    """Return why rows cannot be trained: a change that does not go with the recipe.

    Raises:
        ValueError: for one that was asked for by name.
    """
    refused: dict[str, str] = {}
    for row in rows:
        try:
            check_recipe(row.recipe)
        except ValueError as error:
            if named:
                raise ValueError(f"--only {row.key!r}: {error}") from None
            refused[row.key] = str(error)
    return refused


def is_round(row: training.Row) -> bool:
    """Return whether a row is about round gates, which the judge does not have."""
    return row.recipe.episode.gate_corners != 4


def _failures(runs: Sequence[training.Trained]) -> dict[str, str]:
    """Return what the seeds of rows said of which a training diverged.

    Raises:
        WorkFailed: where the recipe's own training diverged, with which all are compared.
    """
    failures: dict[str, str] = {}
    for run in runs:
        if run.diverged:
            before = f"{failures[run.row]}; " if run.row in failures else ""
            failures[run.row] = f"{before}seed {run.seed}: {run.diverged}"
    if RECIPE in failures:
        raise WorkFailed(f"the recipe itself, {failures[RECIPE]}")
    return failures


def compared(
    key: str, mine: Sequence[Sequence[TrialResult]], base: np.ndarray, seconds: float
) -> Compared:
    """Return a row.

    Args:
        key: its name.
        mine: results of each training seed, the same trials in the same order.
        base: which of them the recipe's trainings won, (seeds, trials) bool.
        seconds: median training time.
    """
    won = _won(mine)
    gap, every = crossed(won.astype(float) - base), [row for rows in mine for row in rows]
    return Compared(
        key=key,
        success=won.mean(axis=1).tolist(),
        difference=gap.difference,
        of_seeds=gap.of_seeds,
        v_max=float(np.median([row.v_max for row in every])),
        collisions=float(np.mean([row.ended_by == "collision" for row in every])),
        timeouts=float(np.mean([row.ended_by == "timeout" for row in every])),
        seconds=seconds,
    )


def _won(results: Sequence[Sequence[TrialResult]]) -> np.ndarray:
    return np.array([[row.success for row in rows] for rows in results])


def lead(rows: Sequence[Compared]) -> str:
    """Return in sentences which changes are gains and which losses."""
    said = [f"Of the recipe's trials {100 * float(np.mean(rows[0].success)):.0f} % succeed."]
    for verdict, words in (("gain", "More succeed with"), ("loss", "Fewer succeed with")):
        named = [
            f"{row.key} ({points_cell(row.difference).text})"
            for row in rows[1:]
            if row.gap.verdict == verdict
        ]
        if named:
            said.append(f"{words} {', '.join(named)}.")
    unclear = [row.key for row in rows[1:] if row.gap.verdict == "unclear"]
    if unclear:
        said.append(f"These trainings do not tell for {', '.join(unclear)}.")
    return " ".join(said)


def _round_words(row: Summary) -> str:
    cross, words = row.text("success_cross"), row.words[0].upper() + row.words[1:]
    return f"{words}: {cross} % of the tracks are crossed."


def _grid(judged: Sequence[training.Row], rows: Sequence[Compared]) -> Grid:
    headers = ["row", "what", "changes", "success [%]", "difference [points]", "by seed",
               "v_max [m/s]", "collisions [%]", "timeouts [%]", "training", ""]  # fmt: skip
    lines = []
    for (_, words, _, changes), row in zip(judged, rows, strict=True):
        seeds = " ".join(f"{round(100 * gap) + 0:+d}" for gap in row.of_seeds)
        success = ranged(*spread([100 * rate for rate in row.success]), 0)
        told = ("-", "-", "") if row.key == RECIPE else (
            points_cell(row.difference), seeds, row.gap.verdict
        )  # fmt: skip
        lines.append(
            [
                row.key,
                words,
                " ".join(f"`{change}`" for change in changes) or "-",
                success,
                *told[:2],
                f"{row.v_max:.2f}",
                f"{100 * row.collisions:.0f}",
                f"{100 * row.timeouts:.0f}",
                duration(row.seconds),
                told[2],
            ]
        )
    return table(headers, lines)


def _round_grid(rounds: Sequence[Summary]) -> Grid:
    headers = ["row", "what", "success cross [%]", "success rate [%]", "v_max [m/s]", "gates"]
    digits = {"success_cross": 0, "success_rate": 0, "v_max": 2, "gates": 2}
    lines = [
        [row.key, row.words, *(row.text(name, digits=d) for name, d in digits.items())]
        for row in rounds
    ]
    return table(headers, lines)

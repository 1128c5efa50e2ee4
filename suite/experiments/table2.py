"""The paper's table of judged policies, ours beside the printed rows; then all ten levels."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from eval.judging.tables import Tally, percent
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import TrialResult
from suite.common.choices import LEVELS
from suite.common.console import Console
from suite.common.report import Picture, Report, Section
from suite.experiments.pages.document import Place
from suite.experiments.pages.goals import goal_grid, goals, verdict
from suite.experiments.pages.paper import sim_to_sim
from suite.experiments.pages.tables import every_cell
from suite.experiments.study import judging, options
from suite.experiments.study.cache import LOOP_ROOMS, code_digest, digest, engines
from suite.judging.content import policy_digest
from suite.judging.flying import default_policy
from suite.loop import compare
from suite.train.overrides import check_owned
from tracks.common.grid import Grid, table
from tracks.families import JUDGED
from tracks.input.ranges import Range, Seed, Trials

if TYPE_CHECKING:
    from suite.loop.config import LoopConfig

OURS, WITH, CONTROL = "ours", "ours, with Delta Action Model", "ours, tuned as long without it"
LOOP_TRIALS = 10
"""Judged trials a cell in the loop's own tables, which are not shown here."""
COLUMNS = [
    header
    for track in JUDGED
    for header in (f"{track} SR", "v_max [m/s]", "of ten [m/s]", "v_mean [m/s]", "lap [s]")
]
"""Of every track."""
MEANINGS = (
    "Success (SR): all 8 gates in order, no contact, within 20 s; ours with its 95 % Wilson "
    "interval, the others as printed, out of 10 trials. v_max: ours is the median over a cell's "
    "trials of each trial's largest speed before any contact; of ten: the mean, over picks of ten "
    "trials, of the largest among them. The paper and the baseline flew ten trials a cell and do "
    "not say whether theirs is a median, a mean or the largest. Simulator, vehicle and tracks are "
    "ours: the tracks follow the baseline's rules, the numbers of the others were measured in "
    "theirs."
)
NO_DELTA = (
    "There is no row of ours with the Delta Action Model: neither --delta-policy nor "
    "--delta-iterations was given."
)
CHART = (
    "Success with 95 % Wilson intervals and median v_max at every level; hollow: printed by the "
    "paper (with Delta Action Model)."
)


@dataclass(frozen=True)
class Config:
    """Judge a policy on three tracks at all ten levels, beside the paper's and the baseline's rows.

    The rows with the Delta Action Model, at the paper's four levels, are there where --delta-policy
    or --delta-iterations is.
    """

    policy: str | None = None
    """A shipped policy's name, a checkpoint's folder or a policy file; by default the shipped."""
    delta_policy: str | None = None
    """The same fine-tuned under a Delta Action Model: tuned-with/policy of a `suite loop`."""
    control_policy: str | None = None
    """The same fine-tuned as long without it: tuned-without/policy of that loop."""
    delta_iterations: Annotated[int, Range(0, 10**9)] = 0
    """Make both by a `suite loop` with as many gradient steps of fine-tuning; 0 does not."""
    delta_set: tuple[str, ...] = ()
    """Settings of that fine-tuning, such as loss.safety_radius_m=0.3."""
    trials: Trials = 100
    """Trials of every policy on every track at every level that it flies."""
    seed: Seed = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""


class TablePolicy(NamedTuple):
    """A policy of the table."""

    name: str
    """What the table calls it."""
    policy: str
    """Name, folder or file."""
    about: str
    """Where it comes from."""


def document(config: Config, place: Place, console: Console) -> tuple[Report, dict[str, Any]]:
    """Return the page and its numbers; what is missing is flown first."""
    vehicle, printed = load_vehicle(config.vehicle), sim_to_sim()
    variants = variants_of(config, place, console)
    orders = {
        v.name: judging.Order(
            judging.Flier(v.policy, vehicle),
            judging.trials_of(config, LEVELS if v.name == OURS else printed.levels),
        )
        for v in variants
    }
    results, cells = judging.judged_cells(
        orders, place.cache, console, "judging all levels", place.workers
    )
    lines = _merit(results)
    everything = [cell for some in cells.values() for cell in some]
    report = Report(
        title="Sim-to-sim: the paper's table and all ten levels",
        lead=" ".join(
            f"{name}: {verdict(goals(cells[name]))}" for name in cells if name != CONTROL
        ),
        facts={
            **{variant.name: variant.about for variant in variants},
            "vehicle": config.vehicle,
            "seeds": f"{options.judged_seeds(config)}, {config.trials} trials a cell, the same "
            "for all",
        },
        sections=list(_sections(cells, lines)),
    )
    return report, {
        "cells": everything,
        "goals": {name: goals(some) for name, some in cells.items()},
        "with_against_without": lines,
        "policies": variants,
    }


def variants_of(config: Config, place: Place, console: Console) -> list[TablePolicy]:
    """Return the policies to be judged; the loop that makes the fine-tuned ones is run if asked.

    Raises:
        ValueError: for a policy that cannot be loaded, or options that exclude each other.
    """
    given = {WITH: config.delta_policy, CONTROL: config.control_policy}
    if config.delta_iterations and any(given.values()):
        raise ValueError(
            "--delta-iterations makes the fine-tuned policies and --delta-policy and "
            "--control-policy name them; give the one or the other"
        )
    policy = config.policy or default_policy()
    if config.delta_set and not config.delta_iterations:
        raise ValueError(
            "--delta-set is of the fine-tuning that --delta-iterations asks for; give that, too"
        )
    chosen = {OURS: policy, **{name: path for name, path in given.items() if path}}
    if config.delta_iterations:
        from suite.common.console import Quiet
        from suite.loop.config import loop_by_content
        from suite.loop.run import run_loop

        loop = loop_config(config, policy)
        about = [loop_by_content(loop), code_digest(*LOOP_ROOMS), engines()]
        folder = place.cache / "loops" / digest(about)
        run_loop(loop, folder, Quiet(), place.workers)
        chosen[WITH] = str(folder / "tuned-with" / "policy")
        chosen[CONTROL] = str(folder / "tuned-without" / "policy")
    made = f"{policy}, fine-tuned by suite loop in {config.delta_iterations} gradient steps"
    variants = []
    for name, path in chosen.items():
        judging.name_of(path)
        label = made if config.delta_iterations and name != OURS else path
        variants.append(TablePolicy(name, path, f"{label}, SHA-256 {policy_digest(path)[:16]}"))
    return variants


def loop_config(config: Config, policy: str) -> LoopConfig:
    """Return the loop that fine-tunes `policy`, on flights of seeds that no table judges."""
    from suite.loop.config import resolve

    owned = {"optimizer.iterations": "give --delta-iterations", "seed": "give --seed"}
    check_owned(config.delta_set, owned, "--delta-set")
    return resolve(
        policy=policy,
        difficulty="0,3,6,9",
        trials=LOOP_TRIALS,
        vehicle=config.vehicle,
        seed=config.seed,
        finetune_iterations=config.delta_iterations,
        changes=config.delta_set,
    )


def _merit(results: Mapping[str, Sequence[TrialResult]]) -> list[compare.Line]:
    """Return what the Delta Action Model changes, trial by trial; nothing without its control."""
    names = {compare.BEFORE: OURS, compare.WITHOUT: CONTROL, compare.WITH: WITH}
    if set(results) != set(names.values()):
        return []
    levels = sim_to_sim().levels
    return compare.compare(
        {
            role: [row for row in results[name] if row.difficulty in levels]
            for role, name in names.items()
        }
    )


def _sections(
    cells: Mapping[str, Sequence[Tally]], lines: Sequence[compare.Line]
) -> Iterator[Section]:
    from suite.experiments.pages.charts import level_chart

    everything = [cell for some in cells.values() for cell in some]
    asides = [] if WITH in cells else [NO_DELTA]
    yield Section("Beside the paper", [*asides, beside_the_paper(cells), MEANINGS])
    if lines:
        parts = [compare.verdict(lines[-1]), *compare.grids(lines)[:1], compare.CAVEAT]
        yield Section("What the Delta Action Model changes", parts)
    for name, some in cells.items():
        yield Section(f"The goal, cell by cell: {name}", [goal_grid(some)])
    picture = Picture(level_chart(everything), CHART)
    levels = [(str(level), *_ours(cells[OURS], level)) for level in LEVELS]
    whole = table(["level", *COLUMNS], levels, OURS)
    yield Section("All ten levels", [where_it_breaks(OURS, cells[OURS]), picture, whole])
    yield every_cell(everything)


def beside_the_paper(cells: Mapping[str, Sequence[Tally]]) -> Grid:
    """Return our rows and the printed ones, a method and level each, tracks as columns."""
    printed = sim_to_sim()
    lines = [
        [name, str(level), *_ours(some, level)]
        for name, some in cells.items()
        for level in printed.levels
    ]
    for method, name in printed.methods.items():
        for level in printed.levels:
            line = [name, str(level)]
            for track in JUDGED:
                (cell,) = (c for c in printed.at(track, level) if c.method == method)
                line += [f"{cell.won}/{cell.trials}", f"{cell.v_max:.1f}", "-", "-", "-"]
            lines.append(line)
    return table(["method", "level", *COLUMNS], lines, note=f"Printed rows: {printed.source}.")


def _ours(cells: Sequence[Tally], level: int) -> list[str]:
    """Return one policy's numbers at a level, track by track."""
    by_track, texts = {cell.track: cell for cell in cells if cell.difficulty == level}, []
    for cell in (by_track[track] for track in JUDGED):
        lap = "-" if math.isnan(cell.lap_s.value) else f"{cell.lap_s.value:.1f}"
        speeds = (cell.v_max.value, cell.v_max_of_ten, cell.v_mean.value)
        texts += [percent(cell.success), *("-" if v is None else f"{v:.1f}" for v in speeds)]
        texts.append(lap)
    return texts


def where_it_breaks(policy: str, cells: Sequence[Tally]) -> str:
    """Return up to which level a policy flies each track well, and by half."""
    parts = []
    for track in JUDGED:
        rates = {c.difficulty: c.success.value for c in cells if c.track == track}
        parts.append(f"{track} {_up_to(rates, 0.9)} (half: {_up_to(rates, 0.5)})")
    return f"Levels up to which at least 90 % of trials succeed, {policy}: {', '.join(parts)}."


def _up_to(rates: dict[int, float], least: float) -> str:
    good = [str(level) for level in itertools.takewhile(lambda k: rates[k] >= least, sorted(rates))]
    return good[-1] if good else "none"

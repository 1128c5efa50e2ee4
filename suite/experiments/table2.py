"""The paper's table of judged policies, ours next to the printed rows; then all ten levels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, NamedTuple

from eval.judging.tables import Tally, percent
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import TrialResult
from suite.common.choices import LEVELS
from suite.common.console import Console
from suite.common.report import Picture
from suite.experiments.pages.document import Made, Place
from suite.experiments.pages.goals import goal_grid, goals, met_grid
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


@dataclass(frozen=True)
class Config:
    """Judge a policy on three tracks at all ten levels, next to the paper's and baseline's rows.

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


def document(config: Config, place: Place, console: Console) -> Made:
    """Return tables and numbers; what is missing is flown first."""
    from suite.experiments.pages.charts import level_chart

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
    facts = {
        **{variant.name: variant.about for variant in variants},
        "vehicle": config.vehicle,
        "seeds": f"{options.judged_seeds(config)}, {config.trials} trials a cell, the same for all",
    }
    levels = [(str(level), *_ours(cells[OURS], level)) for level in LEVELS]
    delta = {"With the Delta Action Model": compare.grids(lines)[:1]} if lines else {}
    parts = {
        "Compared with the paper": [against_the_paper(cells)],
        **delta,
        "Cells that meet the goals": [met_grid(cells)],
        **{f"Goals by cell: {name}": [goal_grid(some)] for name, some in cells.items()},
        "All ten levels": [
            Picture(level_chart(everything), "Success and v_max at every level"),
            table(["level", *COLUMNS], levels, OURS),
        ],
        "Every cell with its intervals": every_cell(everything),
    }
    numbers = {
        "cells": everything,
        "goals": {name: goals(some) for name, some in cells.items()},
        "with_against_without": lines,
        "policies": variants,
    }
    return Made(facts, parts, numbers)


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


def against_the_paper(cells: Mapping[str, Sequence[Tally]]) -> Grid:
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

"""The paper's table of judged policies, ours next to the printed rows; then all ten levels."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from eval.judging.tables import Tally, grids, percent, summarise
from eval.quadrotor.vehicle_file import load_vehicle
from eval.sensors.sensors_file import load_sensors
from eval.worlds.trial import TrialResult
from suite.common.choices import LEVELS
from suite.common.console import Console
from suite.common.report import Picture
from suite.experiments.pages.document import Made
from suite.experiments.pages.paper import goal_grid, goals, sim_to_sim
from suite.experiments.study import judging, options
from suite.experiments.study.cache import Place
from suite.judging.flying import default_policy
from suite.loop import compare
from tracks.common.grid import Grid, table
from tracks.families import JUDGED
from tracks.input.ranges import Seed, Trials

OURS, WITH, CONTROL = "ours", "ours, with Delta Action Model", "ours, tuned as long without it"
COLUMNS = [
    header
    for track in JUDGED
    for header in (f"{track} SR", "v_max [m/s]", "of ten [m/s]", "v_mean [m/s]", "lap [s]")
]
"""Of every track."""


@dataclass(frozen=True)
class Config:
    """Judge a policy on three tracks at all ten levels, next to the paper's and baseline's rows.

    The rows with the Delta Action Model are at the paper's four levels and need --delta-policy.
    """

    policy: str | None = None
    """A shipped policy's name, a checkpoint's folder or a policy file; by default the shipped."""
    delta_policy: str | None = None
    """The same fine-tuned with a Delta Action Model: tuned-with/policy of a `suite loop`."""
    control_policy: str | None = None
    """The same fine-tuned as long without it: tuned-without/policy of that loop."""
    trials: Trials = 100
    """Trials of every policy on every track at every level that it flies."""
    seed: Seed = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""
    sensors: str = "perfect"
    """What policies see of the truth: shipped sensors' name or a sensors file (.toml)."""


def document(config: Config, place: Place, console: Console) -> Made:
    """Return tables and numbers; what is missing is flown first."""
    from suite.experiments.pages.charts import level_chart

    vehicle, printed = load_vehicle(config.vehicle), sim_to_sim()
    sensors = load_sensors(config.sensors)
    given = {WITH: config.delta_policy, CONTROL: config.control_policy}
    policies = {OURS: config.policy or default_policy(), **{n: p for n, p in given.items() if p}}
    for path in policies.values():
        judging.name_of(path)
    about = judging.policy_facts(policies)
    orders = {
        name: judging.Order(
            judging.Setup(policy, vehicle, sensors),
            judging.trials_of(config, LEVELS if name == OURS else printed.levels),
        )
        for name, policy in policies.items()
    }
    results = judging.flown(orders, place, console, "judging all levels")
    cells = {
        name: summarise([row._replace(policy=name) for row in rows])["cells"]
        for name, rows in results.items()
    }
    lines = _merit(results)
    everything = [cell for some in cells.values() for cell in some]
    facts = {
        **about,
        "vehicle": config.vehicle,
        "sensors": config.sensors,
        "seeds": f"{options.judged_seeds(config)}, {config.trials} trials a cell, the same for all",
    }
    named = [c._replace(policy=judging.name_of(policies[c.policy])) for c in everything]
    delta = {"With the Delta Action Model": compare.grids(lines)[:1]} if lines else {}
    parts = {
        "Compared with the paper": [against_the_paper(cells)],
        **delta,
        **{f"Goals by cell: {name}": [goal_grid(some)] for name, some in cells.items()},
        "All ten levels": [
            Picture(level_chart(named), "Success and v_max at every level"),
            *grids({"cells": everything, "paired": []}),
        ],
    }
    numbers = {
        "cells": everything,
        "goals": {name: goals(some) for name, some in cells.items()},
        "with_against_without": lines,
        "policies": [{"name": n, "policy": p, "about": about[n]} for n, p in policies.items()],
    }
    return Made(facts, parts, numbers)


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

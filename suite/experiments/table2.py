"""The page `table2`: a policy on three tracks at all ten levels, and the paper's table.

"Printed" numbers are those of the paper.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from eval.judging.tables import Tally, grids, percent, summarise
from eval.quadrotor.vehicle_file import load_vehicle
from eval.sensors.sensors_file import load_sensors
from suite.common.console import Console
from suite.common.report import Picture
from suite.experiments.pages.document import PageContents
from suite.experiments.pages.paper import goal_grid, goals, sim_to_sim
from suite.experiments.study import judging, options
from suite.experiments.study.cache import Workspace
from suite.judging.flying import default_policy
from suite.judging.trials import LEVELS
from tracks.common.grid import Grid, table
from tracks.families import JUDGED
from tracks.input.ranges import Seed, Trials

OURS = "ours"
"""Label of the judged policy in the tables, which also have the paper's methods."""
COLUMNS = [
    header
    for track in JUDGED
    for header in (f"{track} SR", "v_max [m/s]", "largest of 10 [m/s]", "v_mean [m/s]", "lap [s]")
]
"""Columns of the table: five for each track. SR is the success rate."""


@dataclass(frozen=True)
class Config:
    """Judge a policy on three tracks at all ten levels, next to the paper's and baseline's rows."""

    policy: str | None = None
    """A shipped policy's name, a checkpoint's folder or a policy file; the shipped one by
    default."""
    trials: Trials = 100
    """Trials on every track at every level."""
    seed: Seed = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""
    sensors: str = "perfect"
    """Errors in what the policy sees: a shipped name or a sensors file (.toml)."""


def document(config: Config, workspace: Workspace, console: Console) -> PageContents:
    """Return the contents of the page; trials that are not in the cache are flown first."""
    from suite.experiments.pages.charts import level_chart

    policy = config.policy or default_policy()
    name, policies = judging.policy_name(policy), judging.policy_facts({OURS: policy})
    vehicle, sensors = load_vehicle(config.vehicle), load_sensors(config.sensors)
    trials = judging.judged_trials(config, LEVELS)
    request = judging.TrialRequest(policy, vehicle, trials, sensors)
    rows = judging.fly_trials({OURS: request}, workspace, console, "judging all levels")[OURS]
    cells = summarise([row._replace(policy=OURS) for row in rows])["cells"]
    seeds = options.judged_seeds(config)
    facts = {
        **policies,
        "vehicle": config.vehicle,
        "sensors": config.sensors,
        "seeds": f"{seeds}, {config.trials} trials per cell, the same for all",
    }
    chart = level_chart([cell._replace(policy=name) for cell in cells])
    parts = {
        "Compared with the paper": [paper_grid(cells)],
        f"Goals by cell: {OURS}": [goal_grid(cells)],
        "All ten levels": [
            Picture(chart, "Success and v_max at every level"),
            *grids({"cells": cells, "paired": []}),
        ],
    }
    numbers = {
        "cells": cells,
        "goals": {OURS: goals(cells)},
        "policies": [{"name": OURS, "policy": policy, "about": policies[OURS]}],
    }
    return PageContents(facts, parts, numbers)


def paper_grid(cells: Sequence[Tally]) -> Grid:
    """Return a table of our results and the printed ones.

    It has a row per method and level, and the columns of each track next to each other. The paper
    prints no largest of ten, mean speed and lap.
    """
    printed = sim_to_sim()
    lines = [[OURS, str(level), *_our_numbers(cells, level)] for level in printed.levels]
    for method, name in printed.methods.items():
        for level in printed.levels:
            line = [name, str(level)]
            for track in JUDGED:
                (cell,) = (c for c in printed.at(track, level) if c.method == method)
                line += [f"{cell.won}/{cell.trials}", f"{cell.v_max:.1f}", "-", "-", "-"]
            lines.append(line)
    return table(["method", "level", *COLUMNS], lines, note=f"Printed rows: {printed.source}.")


def _our_numbers(cells: Sequence[Tally], level: int) -> list[str]:
    """Return the texts of our row at a level, in the order of COLUMNS."""
    by_track, texts = {cell.track: cell for cell in cells if cell.difficulty == level}, []
    for cell in (by_track[track] for track in JUDGED):
        lap = "-" if math.isnan(cell.lap_s.value) else f"{cell.lap_s.value:.1f}"
        speeds = (cell.v_max.value, cell.v_max_of_ten, cell.v_mean.value)
        texts += [percent(cell.success), *("-" if v is None else f"{v:.1f}" for v in speeds)]
        texts.append(lap)
    return texts

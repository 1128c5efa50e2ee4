"""The tables of `suite reproduce table2`."""

from __future__ import annotations

import math
from collections.abc import Sequence

from eval.judging.tables import Cell as Judged
from eval.judging.tables import percent
from suite.common.report import Cell, Grid
from suite.experiments.goals import SURE, goals
from suite.experiments.paper import Printed, sim_to_sim
from tracks.families import JUDGED

MEANINGS = (
    "Success (SR): all 8 gates in order, no contact, within 20 s; ours with its 95 % Wilson "
    "interval, the others as printed, out of 10 trials. v_max: ours is the median over a cell's "
    "trials of each trial's largest speed before any contact; the paper and the baseline do not "
    "say over what theirs is the maximum. Simulator, vehicle and tracks are ours: the tracks "
    "follow the baseline's rules, the numbers of the others were measured in theirs."
)
NO_DELTA = (
    "There is no row of ours with the Delta Action Model: neither --delta-policy nor "
    "--delta-iterations was given."
)
CHART = (
    "Success with 95 % Wilson intervals and median v_max at every level; hollow: printed by the "
    "paper (with Delta Action Model)."
)


def beside_the_paper(cells: Sequence[Judged]) -> Grid:
    """Return our rows and the printed ones, a method and level each, tracks as columns."""
    printed = sim_to_sim()
    headers = ["method", "level"]
    for track in JUDGED:
        headers += [f"{track} SR", "v_max [m/s]", "v_mean [m/s]", "lap [s]"]
    by_key = {(cell.policy, cell.track, cell.difficulty): cell for cell in cells}
    rows = []
    for policy in dict.fromkeys(cell.policy for cell in cells):
        for level in printed.levels:
            row = [Cell(policy), Cell(str(level))]
            for track in JUDGED:
                row += _ours(by_key[policy, track, level])
            rows.append(row)
    for method, name in printed.methods.items():
        for level in printed.levels:
            row = [Cell(name), Cell(str(level))]
            for track in JUDGED:
                (cell,) = (c for c in printed.at(track, level) if c.method == method)
                row += _theirs(cell)
            rows.append(row)
    return Grid("", headers, rows, note=f"Printed rows: {printed.source}.")


def _ours(cell: Judged) -> list[Cell]:
    numbers = (f"{cell.v_max.value:.1f}", f"{cell.v_mean.value:.1f}", _lap(cell))
    return [Cell(percent(cell.success)), *map(Cell, numbers)]


def _theirs(cell: Printed) -> list[Cell]:
    texts = (f"{cell.won}/{cell.trials}", f"{cell.v_max:.1f}", "-", "-")
    return [Cell(text) for text in texts]


def _lap(cell: Judged) -> str:
    return "-" if math.isnan(cell.lap_s.value) else f"{cell.lap_s.value:.1f}"


def goal_grid(cells: Sequence[Judged]) -> Grid:
    """Return by how much each cell of one policy misses what is asked of it."""
    by_key = {(cell.track, cell.difficulty): cell for cell in cells}
    headers = ["track", "level", "success", "best of the others", "missed by", "floor",
               "missed by", "v_max [m/s]", "largest of the others", "missed by"]  # fmt: skip
    rows = []
    for goal in goals(cells):
        cell = by_key[goal.track, goal.level]
        texts = [
            goal.track,
            str(goal.level),
            percent(cell.success),
            f"{100 * goal.success:.0f} %",
            _missed(100 * goal.success_miss, "points"),
            f"{100 * goal.floor:.0f} %",
            _missed(100 * goal.floor_miss, "points"),
            f"{cell.v_max.value:.2f}",
            f"{goal.v_max:.1f}",
            _missed(goal.v_max_miss, "m/s"),
        ]
        rows.append([Cell(text) for text in texts])
    note = (
        "Asked of success: the better of the paper's and the baseline's rate; where that is 10 of "
        f"10, a Wilson interval from {100 * SURE:.0f} % up. The floor is what the shipped policy "
        "is to reach. Asked of v_max: the largest of the printed ones."
    )
    return Grid("", headers, rows, note=note)


def _missed(by: float, unit: str) -> str:
    return f"{by:.1f} {unit}" if by else "met"


def all_levels(policy: str, cells: Sequence[Judged]) -> Grid:
    """Return one policy's success, speed and lap time at every level."""
    headers = ["level"]
    for track in JUDGED:
        headers += [f"{track} SR", "v_max [m/s]", "v_mean [m/s]", "lap [s]"]
    by_key = {(cell.track, cell.difficulty): cell for cell in cells}
    rows = []
    for level in sorted({cell.difficulty for cell in cells}):
        row = [Cell(str(level))]
        for track in JUDGED:
            row += _ours(by_key[track, level])
        rows.append(row)
    return Grid(policy, headers, rows)


def where_it_breaks(policy: str, cells: Sequence[Judged]) -> str:
    """Return up to which level a policy flies each track well, and by half."""
    parts = []
    for track in JUDGED:
        rates = {c.difficulty: c.success.value for c in cells if c.track == track}
        parts.append(f"{track} {_up_to(rates, 0.9)} (half: {_up_to(rates, 0.5)})")
    return f"Levels up to which at least 90 % of trials succeed, {policy}: {', '.join(parts)}."


def _up_to(rates: dict[int, float], least: float) -> str:
    reached = "none"
    for level in sorted(rates):
        if rates[level] < least:
            break
        reached = str(level)
    return reached

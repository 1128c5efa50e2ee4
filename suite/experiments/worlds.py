"""The shipped policies in every world, on the same trials: where worlds differ, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import tyro

from eval.judging.statistics import paired_success, wilson
from eval.judging.tables import percent
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle
from eval.worlds import REFERENCE, WORLDS, differences, world_class
from eval.worlds.trial import TrialResult
from policies import shipped
from suite.common.console import Console
from suite.common.report import Report, Section
from suite.experiments.pages.document import Place
from suite.experiments.pages.tables import points_cell
from suite.experiments.study import judging, options
from tracks.common.grid import Cell, Grid, table
from tracks.families import JUDGED
from tracks.input.ranges import Seed, Trials

BASE = "mujoco"
"""The world that the others are held against."""
ROUNDING = "mjx"
"""The world that flies as the first does but for rounding to single precision, contacts by distance
and images by analytic rays."""
OTHERWISE = {
    "rounding": "it changes in mjx, too: single precision, contacts by distance or images by "
    "analytic rays are enough",
    "air": "mujoco ends as the world does once its vehicle has that world's air",
    "rest": "neither: what the world has and no vehicle file of ours says, its steps among it",
}
"""What may decide a flight that ends otherwise, in words."""
MEANINGS = (
    "Success: rate over all cells, 95 % Wilson interval. Minus mujoco: in points on the same "
    "trials, with Newcombe's paired 95 % interval; p: McNemar's exact test. Ends alike: trials "
    "that end in the same way (`ended_by`). Lap and mean speed: the median over the trials that "
    "are finished in both worlds of how far the two are apart."
)


@dataclass(frozen=True)
class Config:
    """Fly the shipped policies on the same trials in every world, side by side."""

    policy: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A shipped policy's name, a checkpoint's folder or a policy file; may be given several times.
    Without it all shipped policies fly."""
    world: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A world beside mujoco; may be given several times. Without it mjx and rotorpy."""
    difficulty: str = "0,9"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials = 20
    """Trials of every policy on every track at every level in every world."""
    seed: Seed = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""


class Column(NamedTuple):
    """A world as the tables have it."""

    label: str
    world: str
    vehicle: Vehicle
    """What it is given; for a control, one that flies as another world's does."""
    control_of: str | None = None
    """The world whose air the vehicle has."""


Flown = Mapping[tuple[str, str], Sequence[TrialResult]]
"""Results by policy and column, the trials in one order."""


def columns(config: Config) -> list[Column]:
    """Return what is flown, mujoco first.

    Raises:
        ValueError: for a world that there is not, or that lacks a package.
    """
    vehicle = load_vehicle(config.vehicle)
    twice = next((name for name in config.world if config.world.count(name) > 1), None)
    if twice is not None:
        raise ValueError(f"--world {twice} is given twice; give each world once")
    found = [Column(BASE, BASE, vehicle)]
    for name in config.world or (ROUNDING, "rotorpy"):
        world = world_class(name)
        if name in (BASE, REFERENCE):
            others = ", ".join(known for known in WORLDS if known not in (BASE, REFERENCE))
            raise ValueError(
                f"--world {name}: flies as {BASE} does, with which others are paired; give one of "
                + others
            )
        if hasattr(world, "nearest"):
            label = f"{BASE}, the air of {name}"
            found.append(Column(label, BASE, world.nearest(vehicle), name))
        found.append(Column(name, name, vehicle))
    return found


def document(config: Config, place: Place, console: Console) -> tuple[Report, dict[str, Any]]:
    """Return the page and its numbers; what is missing is flown first."""
    flown_in = columns(config)
    policies = judging.named_policies(config.policy or tuple(shipped.names()))
    names = list(policies)
    trials = judging.trials_of(config)
    orders = {
        (name, column.label): judging.Order(
            judging.Flier(policy, column.vehicle, world=column.world), trials
        )
        for name, policy in policies.items()
        for column in flown_in
    }
    what = "flying in every world"
    results = judging.flown(orders, place.cache, console, what, place.workers)
    changed = changes(names, flown_in, results)
    report = Report(
        title="Worlds: the same trials in other simulators",
        lead=_lead(names, flown_in, results, changed),
        facts={
            **judging.policy_facts(policies),
            "trials": f"three tracks, levels {config.difficulty}, seeds "
            f"{options.judged_seeds(config)}: {len(trials)} of each policy in each world",
            "vehicle": config.vehicle,
        },
        sections=[
            Section("Side by side", [_overall(names, flown_in, results), MEANINGS]),
            Section("Every cell", [_cells(names, flown_in, results)]),
            Section("Which flights, and why", _why(changed, flown_in)),
            Section("What the worlds fly otherwise", [_otherwise(flown_in)]),
        ],
    )
    return report, {
        "success": [
            {"policy": name, "column": column.label, **_numbers(results, name, column.label)}
            for name in names
            for column in flown_in
        ],
        "changed": changed,
    }


def _won(rows: Sequence[TrialResult]) -> np.ndarray:
    return np.array([row.success for row in rows])


def _numbers(results: Flown, name: str, label: str) -> dict[str, Any]:
    rows, base = results[name, label], results[name, BASE]
    won = _won(rows)
    pairs = [(a, b) for a, b in zip(rows, base, strict=True) if a.success and b.success]

    def apart(of: str) -> float | None:
        gaps = [abs(getattr(a, of) - getattr(b, of)) for a, b in pairs]
        return float(np.median(gaps)) if gaps else None

    return {
        "success": wilson(int(won.sum()), len(won)),
        "minus_mujoco": paired_success(won, _won(base)),
        "ends_alike": sum(a.ended_by == b.ended_by for a, b in zip(rows, base, strict=True)),
        "trials": len(rows),
        "lap_apart_s": apart("time_s"),
        "v_mean_apart": apart("v_mean"),
    }


def _overall(names: Sequence[str], flown_in: Sequence[Column], results: Flown) -> Grid:
    headers = ["policy", "world", "success", "minus mujoco", "p", "ends alike"]
    headers += ["lap apart [s]", "mean speed apart [m/s]"]
    lines = []
    for name in names:
        for column in flown_in:
            found = _numbers(results, name, column.label)
            line = [name, column.label, percent(found["success"])]
            if column.label == BASE:
                lines.append([*line, *[""] * 5])
                continue
            less = found["minus_mujoco"]
            gaps = (found["lap_apart_s"], found["v_mean_apart"])
            alike = f"{found['ends_alike']} of {found['trials']}"
            told = ["-" if gap is None else f"{gap:.3f}" for gap in gaps]
            lines.append([*line, points_cell(less), f"{less.p_value:.2g}", alike, *told])
    return table(headers, lines)


def _cells(names: Sequence[str], flown_in: Sequence[Column], results: Flown) -> Grid:
    headers = ["policy", "track", "level", *(column.label for column in flown_in)]
    lines = []
    for name in names:
        cells = dict.fromkeys(row.trial[:2] for row in results[name, BASE])
        for track, level in sorted(cells, key=lambda cell: (JUDGED.index(cell[0]), cell[1])):
            line = [name, track, str(level)]
            for column in flown_in:
                rows = [r for r in results[name, column.label] if r.trial[:2] == (track, level)]
                line.append(percent(wilson(sum(row.success for row in rows), len(rows))))
            lines.append(line)
    return table(headers, lines)


def changes(
    names: Sequence[str], flown_in: Sequence[Column], results: Flown
) -> list[dict[str, Any]]:
    """Return the trials whose success in a world is not that in mujoco.

    Each has the endings by column, and `why`: a key of `OTHERWISE`, told by the controls that were
    flown; in `ROUNDING` itself and in controls it is None.
    """
    has_rounding = any(column.world == ROUNDING for column in flown_in)
    found = []
    for name in names:
        for column in flown_in[1:]:
            own = [c.label for c in flown_in if c.control_of == column.world]
            told = column.world not in (BASE, ROUNDING)
            for number, base in enumerate(results[name, BASE]):
                row = results[name, column.label][number]
                if row.success == base.success:
                    continue
                why = None
                if told:
                    aired = any(results[name, c][number].success == row.success for c in own)
                    why = "air" if aired else "rest"
                    if has_rounding and results[name, ROUNDING][number].success != base.success:
                        why = "rounding"
                ends = {c.label: results[name, c.label][number].ending for c in flown_in}
                found.append(
                    {"policy": name, "column": column.label, "trial": row.trial, "why": why,
                     "endings": ends}
                )  # fmt: skip
    return found


def _why(changed: Sequence[Mapping[str, Any]], flown_in: Sequence[Column]) -> list[str | Grid]:
    parts: list[str | Grid] = []
    counts = []
    for column in flown_in[1:]:
        mine = [change for change in changed if change["column"] == column.label]
        counts.append(f"{column.label}: {len(mine)}")
        reasons = [change["why"] for change in mine if change["why"]]
        if reasons:
            each = (f"{reasons.count(why)} {why} ({OTHERWISE[why]})" for why in OTHERWISE)
            parts.append(f"Of those in {column.label}: " + "; ".join(each) + ".")
    parts.insert(0, f"Trials whose success is not that in mujoco, by world: {', '.join(counts)}.")
    told = [change for change in changed if change["why"]]
    if told:
        headers = ["policy", "track", "level", "seed", *(c.label for c in flown_in), "why"]
        lines: list[list[str | Cell]] = [
            [c["policy"], c["trial"].track, str(c["trial"].difficulty), str(c["trial"].seed)]
            + [c["endings"][column.label] for column in flown_in]
            + [c["why"]]
            for c in told
        ]
        parts.append(table(headers, lines))
    return parts


def _otherwise(flown_in: Sequence[Column]) -> str:
    lines = [
        f"- {column.label}: {sentence}"
        for column in flown_in
        for sentence in differences(column.world, column.vehicle)
    ]
    return "\n".join(lines) or "Every world flies the vehicle as its file says."


def _lead(
    names: Sequence[str],
    flown_in: Sequence[Column],
    results: Flown,
    changed: Sequence[Mapping[str, Any]],
) -> str:
    sentences = []
    for column in flown_in[1:]:
        if column.control_of:
            continue
        each = []
        for name in names:
            found = _numbers(results, name, column.label)
            points = points_cell(found["minus_mujoco"]).text
            each.append(f"{name} {percent(found['success'])}, {points} points against mujoco")
        count = sum(change["column"] == column.label for change in changed)
        total = sum(len(results[name, column.label]) for name in names)
        sentences.append(
            f"In {column.label}: {'; '.join(each)}; {count} of {total} trials change their success."
        )
    return " ".join(sentences)

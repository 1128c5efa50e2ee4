"""The shipped policies in every simulator on the same trials: where simulators differ, and why."""

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
from suite.experiments.pages.document import Made
from suite.experiments.study import judging, options
from suite.experiments.study.cache import Place
from suite.loop.compare import difference_cell
from tracks.common.grid import Grid, table
from tracks.input.ranges import Trials

BASE = "mujoco"
"""The simulator that the others are compared with."""
ROUNDING = "mjx"
"""The simulator that differs from `BASE` only in single precision, in contacts found by signed
distance, and in images from analytic rays."""
WHY = ("rounding", "air", "rest")
"""Why a trial's outcome changes: `rounding`, it changes in mjx too; `air`, it changes in mujoco too
with that simulator's aerodynamics; `rest`, neither."""


@dataclass(frozen=True)
class Config(options.Judged):
    """Fly the shipped policies on the same trials in every simulator."""

    policy: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A shipped policy's name, a checkpoint's folder or a policy file; may be given several times.
    Without it all shipped policies fly."""
    difficulty: str = "0,9"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials = 20
    """Trials of every policy on every track at every level in every simulator."""
    simulator: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A simulator besides mujoco; may be given several times. Without it mjx and rotorpy."""


class Column(NamedTuple):
    """A column of the tables: a simulator and the vehicle that it flies."""

    label: str
    simulator: str
    vehicle: Vehicle
    """The vehicle file; of a control, one with the aerodynamics of another simulator."""
    control_of: str | None = None
    """The simulator whose aerodynamics the vehicle has; None for no control."""


Flown = Mapping[tuple[str, str], Sequence[TrialResult]]
"""Results by policy and column, the trials in one order."""


def columns(config: Config) -> list[Column]:
    """Return the columns, mujoco first.

    Raises:
        ValueError: for an unknown simulator, or one whose package is not installed.
    """
    vehicle = load_vehicle(config.vehicle)
    twice = next((n for n in config.simulator if config.simulator.count(n) > 1), None)
    if twice is not None:
        raise ValueError(f"--simulator {twice} is given twice; give each simulator once")
    found = [Column(BASE, BASE, vehicle)]
    for name in config.simulator or (ROUNDING, "rotorpy"):
        simulator = world_class(name)
        if name in (BASE, REFERENCE):
            others = ", ".join(known for known in WORLDS if known not in (BASE, REFERENCE))
            raise ValueError(
                f"--simulator {name}: flies as {BASE} does, with which others are paired; give "
                f"one of {others}"
            )
        if hasattr(simulator, "nearest"):
            label = f"{BASE}, the air of {name}"
            found.append(Column(label, BASE, simulator.nearest(vehicle), name))
        found.append(Column(name, name, vehicle))
    return found


def document(config: Config, place: Place, console: Console) -> Made:
    """Return tables and numbers; what is missing is flown first."""
    flown_in = columns(config)
    policies = judging.named_policies(config.policy or tuple(shipped.names()))
    names = list(policies)
    trials = judging.trials_of(config)
    orders = {
        (name, column.label): judging.Order(
            judging.Setup(policy, column.vehicle, simulator=column.simulator), trials
        )
        for name, policy in policies.items()
        for column in flown_in
    }
    results = judging.flown(orders, place, console, "flying in every simulator")
    changed = changes(names, flown_in, results)
    facts = {
        **judging.policy_facts(policies),
        "trials": f"three tracks, levels {config.difficulty}, seeds "
        f"{options.judged_seeds(config)}: {len(trials)} of each policy in each simulator",
        "vehicle": config.vehicle,
    }
    parts = {
        "Success by simulator": [_overall(names, flown_in, results)],
        "Trials that change their success": [_each(changed, flown_in)],
        "What the simulators fly otherwise": [_otherwise(flown_in)],
    }
    numbers = {
        "success": [
            {"policy": name, "column": column.label, **_numbers(results, name, column.label)}
            for name in names
            for column in flown_in
        ],
        "changed": changed,
    }
    return Made(facts, parts, numbers)


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
    headers = ["policy", "simulator", "success", "minus mujoco", "p", "ends alike"]
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
            shown = ["-" if gap is None else f"{gap:.3f}" for gap in gaps]
            lines.append([*line, difference_cell(less), f"{less.p_value:.2g}", alike, *shown])
    return table(headers, lines)


def changes(
    names: Sequence[str], flown_in: Sequence[Column], results: Flown
) -> list[dict[str, Any]]:
    """Return the trials whose success in a simulator is not that in mujoco.

    Each has the endings by column, and `why`: one of `WHY`, by the controls that were flown; in
    `ROUNDING` itself and in controls it is None.
    """
    has_rounding = any(column.simulator == ROUNDING for column in flown_in)
    found = []
    for name in names:
        for column in flown_in[1:]:
            own = [c.label for c in flown_in if c.control_of == column.simulator]
            explained = column.simulator not in (BASE, ROUNDING)
            for number, base in enumerate(results[name, BASE]):
                row = results[name, column.label][number]
                if row.success == base.success:
                    continue
                why = None
                if explained:
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


def _each(changed: Sequence[Mapping[str, Any]], flown_in: Sequence[Column]) -> Grid:
    """Return the trials that change for a reason of `WHY`, one by one."""
    lines = [
        [c["policy"], c["trial"].track, str(c["trial"].difficulty), str(c["trial"].seed)]
        + [c["endings"][column.label] for column in flown_in]
        + [c["why"]]
        for c in changed
        if c["why"]
    ]
    headers = ["policy", "track", "level", "seed", *(c.label for c in flown_in), "why"]
    return table(headers, lines)


def _otherwise(flown_in: Sequence[Column]) -> Grid:
    lines = [
        [column.label, sentence]
        for column in flown_in
        for sentence in differences(column.simulator, column.vehicle)
    ]
    return table(["simulator", "difference to the vehicle's file"], lines)

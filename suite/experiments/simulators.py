"""The shipped policies on the same trials in every simulator: which trials differ, and why."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

from eval.judging.statistics import paired_success
from eval.judging.tables import percent
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds import REFERENCE, WORLDS, differences, world_class
from policies import shipped
from suite.common.console import Console
from suite.experiments.pages.document import Made
from suite.experiments.study import judging, options
from suite.experiments.study.cache import Place
from suite.experiments.study.conditions import Condition
from suite.experiments.study.disturbed import Tested, flown_under
from suite.loop.compare import difference_cell
from tracks.common.grid import Grid, table
from tracks.input.ranges import Trials

BASE = "mujoco"
"""The simulator that the others are compared with."""
ROUNDING = "mjx"
"""This simulator differs from `BASE` in single precision, in contacts by signed distance, and in
images from analytic rays."""
WHY = ("rounding", "air", "rest")
"""Why the success of a trial changes: `rounding`, it changes in mjx too; `air`, it changes in
mujoco with that simulator's aerodynamics too; `rest`, for another reason."""


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


def air_of(simulator: str) -> str:
    """Return the label of the control of a simulator: mujoco with that simulator's aerodynamics."""
    return f"{BASE}, the air of {simulator}"


def conditions(config: Config) -> list[Condition]:
    """Return the simulators and their controls, mujoco first.

    Raises:
        ValueError: for an unknown simulator, or one whose package is not installed.
    """
    vehicle = load_vehicle(config.vehicle)
    twice = next((n for n in config.simulator if config.simulator.count(n) > 1), None)
    if twice is not None:
        raise ValueError(f"--simulator {twice} is given twice; give each simulator once")
    found = [Condition(BASE, 1.0, "", vehicle)]
    for name in config.simulator or (ROUNDING, "rotorpy"):
        simulator = world_class(name)
        if name in (BASE, REFERENCE):
            others = ", ".join(known for known in WORLDS if known not in (BASE, REFERENCE))
            raise ValueError(
                f"--simulator {name}: flies as {BASE} does, with which others are paired; give "
                f"one of {others}"
            )
        if hasattr(simulator, "nearest"):
            found.append(Condition(air_of(name), 1.0, "", simulator.nearest(vehicle)))
        found.append(Condition(name, 1.0, "", vehicle, simulator=name))
    return found


def document(config: Config, place: Place, console: Console) -> Made:
    """Return tables and numbers; what is missing is flown first."""
    flown_in = conditions(config)
    policies = judging.named_policies(config.policy or tuple(shipped.names()))
    trials = judging.trials_of(config)
    tested, _ = flown_under(flown_in, {}, policies, trials, place, console)
    changed = changes(tested)
    facts = {
        **judging.policy_facts(policies),
        "trials": f"three tracks, levels {config.difficulty}, seeds "
        f"{options.judged_seeds(config)}: {len(trials)} of each policy in each simulator",
        "vehicle": config.vehicle,
    }
    otherwise = [
        [entry.name, sentence]
        for entry in flown_in
        for sentence in differences(entry.simulator, entry.vehicle)
    ]
    parts = {
        "Success by simulator": [_overall(tested)],
        "Trials that change their success": [_each(changed, tested)],
        "What the simulators fly otherwise": [
            table(["simulator", "difference to the vehicle's file"], otherwise)
        ],
    }
    numbers = {
        "success": [
            {"policy": name, "column": entry.condition.name, **_numbers(entry, tested[0], name)}
            for name in policies
            for entry in tested
        ],
        "changed": changed,
    }
    return Made(facts, parts, numbers)


def _numbers(entry: Tested, base: Tested, policy: str) -> dict[str, Any]:
    """Return one policy's results in a simulator, and their difference to those in mujoco."""
    rows, others = entry.results[policy], base.results[policy]
    pairs = [(a, b) for a, b in zip(rows, others, strict=True) if a.success and b.success]

    def apart(field: str) -> float | None:
        gaps = [abs(getattr(a, field) - getattr(b, field)) for a, b in pairs]
        return float(np.median(gaps)) if gaps else None

    return {
        "success": entry.success(policy),
        "minus_mujoco": paired_success(entry.won(policy), base.won(policy)),
        "ends_alike": sum(a.ended_by == b.ended_by for a, b in zip(rows, others, strict=True)),
        "trials": len(rows),
        "lap_apart_s": apart("time_s"),
        "v_mean_apart": apart("v_mean"),
    }


def _overall(tested: Sequence[Tested]) -> Grid:
    headers = ["policy", "simulator", "success", "minus mujoco", "p", "ends alike"]
    headers += ["lap apart [s]", "mean speed apart [m/s]"]
    lines = []
    for name in tested[0].results:
        for entry in tested:
            found = _numbers(entry, tested[0], name)
            line = [name, entry.condition.name, percent(found["success"])]
            if entry is tested[0]:
                lines.append([*line, *[""] * 5])
                continue
            less = found["minus_mujoco"]
            gaps = (found["lap_apart_s"], found["v_mean_apart"])
            alike = f"{found['ends_alike']} of {found['trials']}"
            shown = ["-" if gap is None else f"{gap:.3f}" for gap in gaps]
            lines.append([*line, difference_cell(less), f"{less.p_value:.2g}", alike, *shown])
    return table(headers, lines)


def changes(tested: Sequence[Tested]) -> list[dict[str, Any]]:
    """Return the trials whose success in a simulator is not that in mujoco.

    Each has the endings by simulator, and `why`, one of `WHY`; it is None in mjx and in controls.
    """
    by_name = {entry.condition.name: entry for entry in tested}
    base, *others = tested
    found = []
    for policy, rows in base.results.items():
        for entry in others:
            simulator = entry.condition.simulator
            for number, first in enumerate(rows):
                result = entry.results[policy][number]
                if result.success == first.success:
                    continue
                # Whether the two controls change the success of this trial as well.
                rounding, air = (
                    name in by_name
                    and by_name[name].results[policy][number].success == result.success
                    for name in (ROUNDING, air_of(simulator))
                )
                why = "rounding" if rounding else "air" if air else "rest"
                found.append(
                    {
                        "policy": policy,
                        "column": entry.condition.name,
                        "trial": result.trial,
                        "why": None if simulator in (BASE, ROUNDING) else why,
                        "endings": {
                            name: each.results[policy][number].ending
                            for name, each in by_name.items()
                        },
                    }
                )
    return found


def _each(changed: Sequence[Mapping[str, Any]], tested: Sequence[Tested]) -> Grid:
    """Return the trials that change for a reason of `WHY`, one by one."""
    names = [entry.condition.name for entry in tested]
    lines = [
        [c["policy"], c["trial"].track, str(c["trial"].difficulty), str(c["trial"].seed)]
        + [c["endings"][name] for name in names]
        + [c["why"]]
        for c in changed
        if c["why"]
    ]
    return table(["policy", "track", "level", "seed", *names, "why"], lines)

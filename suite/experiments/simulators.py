"""The page `simulators`: policies on the same trials in every simulator, and why results differ.

Where a simulator has other aerodynamics than MuJoCo, a control flies MuJoCo with these
aerodynamics, which separates their effect from other differences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

from eval.judging.tables import percent
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds import WORLDS, differences, nearest
from policies import shipped
from suite.common.console import Console
from suite.experiments.pages.document import PageContents
from suite.experiments.study import judging, options
from suite.experiments.study.cache import Workspace
from suite.experiments.study.conditions import Condition, ConditionResult, fly_conditions
from suite.loop.compare import difference_cell
from tracks.common.grid import Grid, table
from tracks.input.ranges import Trials

BASE = "mujoco"
"""The simulator that the others are compared with."""
ROUNDING = "mjx"
"""The simulator that differs from `BASE` in numerics only: single precision, contacts by signed
distance, and images from analytic rays."""
REASONS = ("rounding", "air", "rest", "rest or rounding")
"""Why the success of a trial changes. `rounding`: it also changes in mjx. `air`: it also changes in
mujoco with that simulator's aerodynamics (the control). `rest`: for another reason; without mjx on
the page it is `rest or rounding`."""


@dataclass(frozen=True)
class Config(options.JudgingOptions):
    """Fly the shipped policies on the same trials in every simulator."""

    policy: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A shipped policy's name, a checkpoint's folder or a policy file; may be given several times.
    Without it all shipped policies fly."""
    difficulty: str = "0,9"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials = 20
    """Trials of every policy on every track at every level in every simulator."""
    simulator: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """A simulator other than mujoco; may be given several times. Without it mjx and rotorpy."""


def control_label(simulator: str) -> str:
    """Return the label of the control of a simulator: mujoco with that simulator's aerodynamics."""
    return f"{BASE}, the air of {simulator}"


def conditions(config: Config) -> list[Condition]:
    """Return the simulators and their controls, mujoco first.

    Raises:
        ValueError: for an unknown simulator, or one whose package is not installed.
    """
    vehicle = load_vehicle(config.vehicle)
    repeated = next((n for n in config.simulator if config.simulator.count(n) > 1), None)
    if repeated is not None:
        raise ValueError(f"--simulator {repeated} is given twice; give each simulator once")
    entries = [Condition(BASE, 1.0, "", vehicle)]
    for name in config.simulator or (ROUNDING, "rotorpy"):
        if name == BASE:
            others = ", ".join(known for known in WORLDS if known != BASE)
            raise ValueError(
                f"--simulator {name}: the page compares the others with it; give one of {others}"
            )
        # A simulator with other aerodynamics offers the vehicle that is nearest to them in mujoco.
        described = nearest(name, vehicle)
        if described is not vehicle:
            entries.append(Condition(control_label(name), 1.0, "", described))
        entries.append(Condition(name, 1.0, "", vehicle, simulator=name))
    return entries


def document(config: Config, workspace: Workspace, console: Console) -> PageContents:
    """Return the contents of the page; trials that are not in the cache are flown first."""
    simulators = conditions(config)
    policies = judging.named_policies(config.policy or tuple(shipped.names()))
    trials = judging.judged_trials(config)
    results = fly_conditions(simulators, policies, trials, workspace, console)
    changed = changed_trials(results)
    facts = {
        **judging.policy_facts(policies),
        "trials": f"three tracks, levels {config.difficulty}, seeds "
        f"{options.judged_seeds(config)}: {len(trials)} of each policy in each simulator",
        "vehicle": config.vehicle,
    }
    simulator_differences = [
        [entry.name, sentence]
        for entry in simulators
        for sentence in differences(entry.simulator, entry.vehicle)
    ]
    parts = {
        "Success by simulator": [_success_grid(results)],
        "Trials that change their success": [_changes_grid(changed, results)],
        "Differences of the simulators to the vehicle file": [
            table(["simulator", "difference to the vehicle file"], simulator_differences)
        ],
    }
    numbers = {
        "success": [
            {"policy": name, "column": entry.condition.name, **_numbers(entry, results[0], name)}
            for name in policies
            for entry in results
        ],
        "changed": changed,
    }
    return PageContents(facts, parts, numbers)


def _numbers(entry: ConditionResult, base: ConditionResult, policy: str) -> dict[str, Any]:
    """Return a policy's results in a simulator (`entry`), and their differences to mujoco (`base`).

    Laps and speeds are compared over the trials that succeed in both.
    """
    rows, base_rows = entry.results[policy], base.results[policy]
    pairs = list(zip(rows, base_rows, strict=True))

    def median_difference(field: str) -> float | None:
        """Return the median absolute difference of a field; None if no trial succeeds in both."""
        succeeded = [(a, b) for a, b in pairs if a.success and b.success]
        values = [abs(getattr(a, field) - getattr(b, field)) for a, b in succeeded]
        return float(np.median(values)) if values else None

    return {
        "success": entry.success(policy),
        "minus_mujoco": entry.minus(base, policy),
        "ends_alike": sum(a.ended_by == b.ended_by for a, b in pairs),
        "trials": len(rows),
        "lap_apart_s": median_difference("time_s"),
        "v_mean_apart": median_difference("v_mean"),
    }


def _success_grid(results: Sequence[ConditionResult]) -> Grid:
    """Return a table of the success rate and its difference to mujoco.

    It has a row per policy and simulator.
    """
    headers = ["policy", "simulator", "success", "minus mujoco", "p", "same ending"]
    headers += ["absolute lap time difference [s]", "absolute mean speed difference [m/s]"]
    rows: list[Any] = []
    for name in results[0].results:
        for entry in results:
            numbers = _numbers(entry, results[0], name)
            row = [name, entry.condition.name, percent(numbers["success"])]
            if entry is results[0]:
                rows.append([*row, *[""] * 5])
                continue
            difference = numbers["minus_mujoco"]
            medians = (numbers["lap_apart_s"], numbers["v_mean_apart"])
            texts = ["-" if value is None else f"{value:.3f}" for value in medians]
            same = f"{numbers['ends_alike']} of {numbers['trials']}"
            p_value = f"{difference.p_value:.2g}"
            rows.append([*row, difference_cell(difference), p_value, same, *texts])
    return table(headers, rows)


def changed_trials(results: Sequence[ConditionResult]) -> list[dict[str, Any]]:
    """Return the trials whose success in a simulator differs from that in mujoco.

    Each entry has `policy`, `column` (the simulator), `trial`, `endings` (how the trial ended, by
    simulator) and `why`, one of `REASONS`. `why` is None for mjx and the controls, which only serve
    to find the reasons.
    """
    by_name = {entry.condition.name: entry for entry in results}
    base, *other_entries = results
    changed = []
    for policy, rows in base.results.items():
        for entry in other_entries:
            simulator = entry.condition.simulator
            for number, base_result in enumerate(rows):
                result = entry.results[policy][number]
                if result.success == base_result.success:
                    continue
                # Whether the two controls change the success of this trial as well.
                rounding, air = (
                    name in by_name
                    and by_name[name].results[policy][number].success == result.success
                    for name in (ROUNDING, control_label(simulator))
                )
                rest = "rest" if ROUNDING in by_name else "rest or rounding"
                why = "rounding" if rounding else "air" if air else rest
                changed.append(
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
    return changed


def _changes_grid(changed: Sequence[Mapping[str, Any]], results: Sequence[ConditionResult]) -> Grid:
    """Return a table of the changed trials that have a reason, a row each."""
    names = [entry.condition.name for entry in results]
    lines = [
        [c["policy"], c["trial"].track, str(c["trial"].difficulty), str(c["trial"].seed)]
        + [c["endings"][name] for name in names]
        + [c["why"]]
        for c in changed
        if c["why"]
    ]
    return table(["policy", "track", "level", "seed", *names, "why"], lines)

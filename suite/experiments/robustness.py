"""The page `robustness`: success of policies under physical effects and growing disturbances.

All policies fly the same trials under every condition.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from eval.judging.tables import percent
from eval.quadrotor.vehicle_file import load_vehicle
from suite.common.console import Console
from suite.common.report import Picture
from suite.experiments.pages.document import PageContents
from suite.experiments.study import conditions, judging, options
from suite.experiments.study.cache import Workspace
from suite.experiments.study.conditions import Condition, ConditionResult
from suite.loop.compare import difference_cell
from tracks.common.grid import Cell, Grid, table


@dataclass(frozen=True)
class Config(options.JudgingOptions):
    """Judge policies under every physical effect and under growing disturbances.

    All policies fly the same trials under every condition. Give a policy that was trained with
    another randomisation as the second one to see the effect of that randomisation.
    """

    only: tuple[str, ...] = ()
    """Only these effects and sweeps, by name; all by default."""


def document(config: Config, workspace: Workspace, console: Console) -> PageContents:
    """Return the contents of the page; trials that are not in the cache are flown first."""
    from suite.experiments.pages.charts import effects_chart, sweeps_chart

    vehicle, policies = load_vehicle(config.vehicle), judging.named_policies(config.policy)
    singles, sweeps = conditions.select_conditions(vehicle, config.only)
    base, trials = Condition("undisturbed", 0.0, "", vehicle), judging.judged_trials(config)
    flown = [base, *singles, *(point for points in sweeps.values() for point in points)]
    results = conditions.fly_conditions(flown, policies, trials, workspace, console)
    effects = results[: 1 + len(singles)]
    sweep_results = conditions.by_sweep(results[len(effects) :], sweeps)
    facts = {
        **judging.policy_facts(policies),
        "trials": f"three tracks, level {config.difficulty}, seeds "
        f"{options.judged_seeds(config)}: {len(trials)} trials per condition, the same in all",
        "vehicle": config.vehicle,
    }
    parts: dict[str, list[Grid | Picture]] = {}
    if singles:
        parts["Every effect at its usual size"] = [
            Picture(effects_chart(effects), "Success under each effect; dashed: undisturbed"),
            condition_grid(effects, effects[0], ("effect", "size in this row")),
        ]
    if sweep_results:
        parts["Growing disturbances"] = [
            Picture(sweeps_chart(sweep_results), "Success against the size of each disturbance"),
            *(
                condition_grid(points, effects[0], (s.axis,), s.name)
                for s, points in sweep_results.items()
            ),
        ]
    numbers = [conditions.tested_numbers(entry, effects[0]) for entry in results]
    return PageContents(facts, parts, {"conditions": numbers})


def condition_grid(
    entries: Sequence[ConditionResult], base: ConditionResult, first: Sequence[str], title: str = ""
) -> Grid:
    """Return a table of the success rates under each of `entries`, and their changes from `base`.

    Every entry has a row. With several policies, further columns compare the others with the first.
    The headers `first` are those of the size, or of the name and the size.
    """
    headers, names = list(first), list(base.results)
    for name in names:
        prefix = f"{name}: " if len(names) > 1 else ""
        headers += [f"{prefix}success", f"{prefix}change"]
    headers += [f"{name} - {names[0]}" for name in names[1:]]
    undisturbed = base.condition
    rows = []
    for entry in entries:
        condition = entry.condition
        # With one header in `first` the row begins with the size, with two with name and size.
        row: list[str | Cell] = [*(condition.name, condition.size_text)[-len(first) :]]
        is_base = (
            condition.vehicle is undisturbed.vehicle and condition.sensors == undisturbed.sensors
        )
        for name in names:
            change = entry.minus(base, name)
            row += [percent(entry.success(name)), "" if is_base else difference_cell(change)]
        row += [difference_cell(entry.minus(entry, name, names[0])) for name in names[1:]]
        rows.append(row)
    return table(headers, rows, title)

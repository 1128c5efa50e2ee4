"""Success under every effect of the catalogue and under growing disturbances, policies in pairs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from eval.judging.statistics import paired_success
from eval.judging.tables import percent
from eval.quadrotor.vehicle_file import load_vehicle
from suite.common.console import Console
from suite.common.report import Picture
from suite.experiments.pages.document import Made
from suite.experiments.study import disturbed, judging, options
from suite.experiments.study.cache import Place
from suite.experiments.study.conditions import Condition
from suite.experiments.study.disturbed import Tested
from suite.loop.compare import difference_cell
from tracks.common.grid import Cell, Grid, table


@dataclass(frozen=True)
class Config(options.Judged):
    """Judge policies under every physical effect and under growing disturbances.

    All policies fly the same trials under every condition. Give a policy that was trained with
    another randomisation as the second one to see the effect of that randomisation.
    """

    only: tuple[str, ...] = ()
    """Only these effects and sweeps, by name; all by default."""


def document(config: Config, place: Place, console: Console) -> Made:
    """Return tables and numbers; what is missing is flown first."""
    from suite.experiments.pages.charts import effects_chart, sweeps_chart

    vehicle, policies = load_vehicle(config.vehicle), judging.named_policies(config.policy)
    alone, sweeps = disturbed.chosen_conditions(vehicle, config.only)
    base, trials = Condition("undisturbed", 0.0, "", vehicle), judging.trials_of(config)
    effects, grown = disturbed.flown_under([base, *alone], sweeps, policies, trials, place, console)
    facts = {
        **judging.policy_facts(policies),
        "trials": f"three tracks, level {config.difficulty}, seeds "
        f"{options.judged_seeds(config)}: {len(trials)} trials a condition, the same in all",
        "vehicle": config.vehicle,
    }
    parts: dict[str, list[Grid | Picture]] = {}
    if alone:
        parts["Every effect at its usual size"] = [
            Picture(effects_chart(effects), "Success under each effect; dashed: undisturbed"),
            condition_grid(effects, effects[0], ("effect", "size in this row")),
        ]
    if grown:
        parts["Growing disturbances"] = [
            Picture(sweeps_chart(grown), "Success against the size of each disturbance"),
            *(condition_grid(points, effects[0], (s.axis,), s.name) for s, points in grown.items()),
        ]
    tested = [*effects, *(point for points in grown.values() for point in points)]
    numbers = [disturbed.tested_numbers(entry, effects[0]) for entry in tested]
    return Made(facts, parts, {"conditions": numbers})


def condition_grid(
    entries: Sequence[Tested], base: Tested, first: Sequence[str], title: str = ""
) -> Grid:
    """Return success and change under each of `entries`, a row each.

    Args:
        entries: tested conditions; the other policies are compared with the first.
        base: the undisturbed condition.
        first: headers of the first columns: the size, or the name and the size.
        title: of the table.
    """
    headers, names = list(first), list(base.results)
    for name in names:
        mine = f"{name}: " if len(names) > 1 else ""
        headers += [f"{mine}success", f"{mine}change"]
    headers += [f"{name} - {names[0]}" for name in names[1:]]
    plain = (base.condition.vehicle, base.condition.sensors)
    lines = []
    for entry in entries:
        line: list[str | Cell] = [*(entry.condition.name, entry.condition.words)[-len(first) :]]
        same = entry.condition.vehicle is plain[0] and entry.condition.sensors == plain[1]
        for name in names:
            change = paired_success(entry.won(name), base.won(name))
            line += [percent(entry.success(name)), "" if same else difference_cell(change)]
        mine = entry.won(names[0])
        line += [difference_cell(paired_success(entry.won(name), mine)) for name in names[1:]]
        lines.append(line)
    return table(headers, lines, title)

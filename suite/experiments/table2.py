"""The paper's table of judged policies, ours beside the printed rows; then all ten levels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from suite.common.choices import LEVELS, at_least
from suite.common.console import Console

if TYPE_CHECKING:
    from eval.judging.tables import Cell
    from eval.worlds.trial import TrialResult
    from suite.common.report import Report
    from suite.experiments.document import Place
    from suite.experiments.variants import Variant
    from suite.loop.compare import Line


@dataclass(frozen=True)
class Config:
    """Judge a policy on three tracks at all ten levels, beside the paper's and the baseline's rows.

    The rows with the Delta Action Model, at the paper's four levels, are there where --delta-policy
    or --delta-iterations is.
    """

    policy: str | None = None
    """A shipped policy's name, a checkpoint's folder or a policy file; by default the shipped."""
    delta_policy: str | None = None
    """The same fine-tuned under a Delta Action Model: tuned-with/policy of a `suite loop`."""
    control_policy: str | None = None
    """The same fine-tuned as long without it: tuned-without/policy of that loop."""
    delta_iterations: int = 0
    """Make both by a `suite loop` with as many gradient steps of fine-tuning; 0 does not."""
    delta_set: tuple[str, ...] = ()
    """Settings of that fine-tuning, such as loss.safety_radius_m=0.3."""
    trials: int = 100
    """Trials of every policy on every track at every level that it flies."""
    seed: int = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""


def run(config: Config, place: Place, console: Console) -> dict[str, Any]:
    """Fly what is missing and write table2.md.

    Raises:
        ValueError: for anything that cannot be used, before the first flight.
    """
    from eval.quadrotor.vehicle_file import load_vehicle
    from suite.experiments.document import write_document
    from suite.experiments.flights import Flier, Order, flown
    from suite.experiments.paper import sim_to_sim
    from suite.experiments.variants import OURS, variants_of
    from suite.judging.flying import trial_list
    from tracks.families import JUDGED

    at_least("--trials", config.trials, 1)
    at_least("--seed", config.seed, 0)
    vehicle = load_vehicle(config.vehicle)
    variants = variants_of(config, place, console)
    flying = {True: LEVELS, False: sim_to_sim().levels}
    orders = [
        Order(
            Flier(variant.policy, vehicle),
            trial_list(JUDGED, flying[variant.name == OURS], config.trials, config.seed),
        )
        for variant in variants
    ]
    results = dict(
        zip(variants, flown(orders, place.cache, console, "judging all levels"), strict=True)
    )
    cells = {variant: _cells(variant, rows) for variant, rows in results.items()}
    lines = _merit(results)
    report = _report(config, cells, lines)
    numbers = {
        "config": config,
        "cells": [cell for some in cells.values() for cell in some],
        "goals": _goals(cells),
        "with_against_without": lines,
        "policies": variants,
    }
    return write_document(place, "table2", report, numbers, config.seed, console)


def _cells(variant: Variant, rows: Sequence[TrialResult]) -> list[Cell]:
    from eval.judging.tables import summarise

    return summarise([row._replace(policy=variant.name) for row in rows])["cells"]


def _merit(results: Mapping[Variant, Sequence[TrialResult]]) -> list[Line]:
    """Return what the Delta Action Model changes, trial by trial; nothing without its control."""
    from suite.experiments import variants
    from suite.experiments.paper import sim_to_sim
    from suite.loop.compare import BEFORE, WITH, WITHOUT, compare

    names = {BEFORE: variants.OURS, WITHOUT: variants.CONTROL, WITH: variants.WITH}
    flown = {variant.name: rows for variant, rows in results.items()}
    if set(flown) != set(names.values()):
        return []
    levels = sim_to_sim().levels
    return compare(
        {
            role: [row for row in flown[name] if row.difficulty in levels]
            for role, name in names.items()
        }
    )


def _goals(cells: Mapping[Variant, Sequence[Cell]]) -> dict[str, Any]:
    from suite.experiments.goals import goals

    return {variant.name: goals(some) for variant, some in cells.items()}


def _report(
    config: Config, cells: Mapping[Variant, Sequence[Cell]], lines: Sequence[Line]
) -> Report:
    from eval.judging.tables import markdown_table
    from suite.common.report import Picture, Report, Section
    from suite.experiments import sim_tables
    from suite.experiments.goals import goals, verdict
    from suite.experiments.level_chart import level_chart
    from suite.experiments.paper import sim_to_sim
    from suite.experiments.variants import OURS, WITH
    from suite.loop.compare import CAVEAT, grids
    from suite.loop.compare import verdict as merit

    printed = sim_to_sim()
    everything = [cell for some in cells.values() for cell in some]
    chosen = [cell for cell in everything if cell.difficulty in printed.levels]
    last = config.seed + config.trials - 1
    whole = {variant: some for variant, some in cells.items() if variant.name == OURS}
    led = [variant for variant in cells if variant.name in (OURS, WITH)]
    asides = [] if len(cells) > 1 else [sim_tables.NO_DELTA]
    return Report(
        title="Sim-to-sim: the paper's table and all ten levels",
        lead=" ".join(f"{variant.name}: {verdict(goals(cells[variant]))}" for variant in led),
        facts={
            **{variant.name: variant.about for variant in cells},
            "vehicle": config.vehicle,
            "seeds": f"{config.seed} to {last}, {config.trials} trials a cell, the same for all",
        },
        sections=[
            Section(
                "Beside the paper",
                [*asides, sim_tables.beside_the_paper(chosen), sim_tables.MEANINGS],
            ),
            *(
                [
                    Section(
                        "What the Delta Action Model changes",
                        [merit(lines[-1]), *grids(lines)[:1], CAVEAT],
                    )
                ]
                if lines
                else []
            ),
            *(
                Section(f"The goal, cell by cell: {variant.name}", [sim_tables.goal_grid(some)])
                for variant, some in cells.items()
            ),
            Section(
                "All ten levels",
                [
                    *(sim_tables.where_it_breaks(v.name, some) for v, some in whole.items()),
                    Picture(level_chart(everything), sim_tables.CHART),
                    *(sim_tables.all_levels(v.name, some) for v, some in whole.items()),
                ],
            ),
            Section(
                "Every cell with its intervals",
                [markdown_table({"cells": everything, "paired": []}).strip("\n")],
            ),
        ],
    )

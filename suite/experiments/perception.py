"""The page `perception`: success rate and speed of policies that get the data of sensor models.

A preset is a shipped sensors file with several models, such as `vio`. A magnitude multiplies the
errors: 0 is a perfect sensor, 1 the usual size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

from eval.judging.statistics import wilson
from eval.judging.tables import percent
from eval.quadrotor.vehicle_file import load_vehicle
from eval.sensors import SENSORS
from eval.sensors.sensors_file import (
    PERFECT,
    SensorSet,
    load_sensors,
    scale_sensors,
    shipped_sensors,
)
from suite.common.console import Console
from suite.common.report import Picture
from suite.experiments.pages.document import PageContents
from suite.experiments.study import conditions, judging, options
from suite.experiments.study.cache import Workspace
from suite.experiments.study.conditions import (
    Condition,
    ConditionResult,
    Sweep,
    sweep_conditions,
)
from suite.loop.compare import difference_cell
from tracks.common.grid import Cell, Grid, table
from tracks.input.ranges import Trials

PRESET_MAGNITUDES = (0.0, 0.5, 1.0, 1.5, 2.0)
"""Magnitudes at which every preset is flown."""
MODEL_MAGNITUDES = (0.0, 1.0, 2.0)
"""Magnitudes at which every single sensor model is flown."""


@dataclass(frozen=True)
class Config(options.JudgingOptions):
    """Judge policies through sensor models: all presets on every cell, and growing magnitudes.

    All policies fly the same trials under every condition. Give a policy that was trained with
    sensor models as the second one to see the effect of that training. Single models are flown by
    the first policy only.
    """

    difficulty: str = "0,3,6,9"
    """Levels of the table of presets: 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials = 50
    """Trials of every policy on every track at every level through every preset."""
    growing_trials: Trials = 32
    """Trials of a policy on every track at level 3 at every magnitude."""
    only: tuple[str, ...] = ()
    """Only these presets and models, by name; all by default."""


def document(config: Config, workspace: Workspace, console: Console) -> PageContents:
    """Return the contents of the page; trials that are not in the cache are flown first."""
    from suite.experiments.pages.charts import sweeps_chart

    # 1. Every preset at its usual size, on all tracks and levels.
    vehicle, presets, models = load_vehicle(config.vehicle), *select_sensor_sets(config.only)
    policies = judging.named_policies(config.policy)
    trials = judging.judged_trials(config)
    base = Condition("perfect", 0.0, "", vehicle)
    preset_conditions = [
        Condition(name, 1.0, "", vehicle, sensors) for name, sensors in presets.items()
    ]
    results = conditions.fly_conditions(
        [base, *preset_conditions], policies, trials, workspace, console
    )

    # 2. Presets and single models at several magnitudes, on level 3.
    sweep_config = replace(config, trials=config.growing_trials)
    sweep_trials = judging.judged_trials(sweep_config, [3])

    def fly_sweeps(
        sets: Mapping[str, SensorSet], magnitudes: Sequence[float], policies: Mapping[str, str]
    ) -> conditions.SweepResults:
        """Return the results of each of `sets` at each of `magnitudes`."""
        axis = "magnitude, times the usual"
        sweeps = [
            Sweep(name, axis, magnitudes, partial(scale_sensors, sensors))
            for name, sensors in sets.items()
        ]
        points = {sweep: sweep_conditions(vehicle, sweep) for sweep in sweeps}
        flown = [point for listed in points.values() for point in listed]
        results = conditions.fly_conditions(flown, policies, sweep_trials, workspace, console)
        return conditions.by_sweep(results, points)

    first_policy = dict([next(iter(policies.items()))])
    preset_sweeps = fly_sweeps(presets, PRESET_MAGNITUDES, policies)
    model_sweeps = fly_sweeps(models, MODEL_MAGNITUDES, first_policy)
    facts = {
        **judging.policy_facts(policies),
        "presets": f"three tracks, levels {config.difficulty}, seeds "
        f"{options.judged_seeds(config)}: {len(trials)} trials per preset, the same in all",
        "magnitudes": f"three tracks, level 3, seeds {options.judged_seeds(sweep_config)}: "
        f"{len(sweep_trials)} trials per magnitude",
        "vehicle": config.vehicle,
    }
    parts: dict[str, list[Grid | Picture]] = {
        "Presets on every cell": [preset_grid(results), *gain_grids(results)],
    }
    for title, points in (
        ("Presets of growing magnitude", preset_sweeps),
        ("Single models of growing magnitude", model_sweeps),
    ):
        if points:
            chart = Picture(sweeps_chart(points), "Success against the magnitude of each")
            parts[title] = [chart, magnitude_grid(points)]
    numbers = [
        conditions.tested_numbers(entry, entries[0])
        for entries in (results, *preset_sweeps.values(), *model_sweeps.values())
        for entry in entries
    ]
    return PageContents(facts, parts, {"conditions": numbers})


def select_sensor_sets(only: Sequence[str]) -> tuple[dict[str, SensorSet], dict[str, SensorSet]]:
    """Return the presets, and single sensor models at their usual size.

    The models are those of the presets `all` and `tof-depth`, without the inertial sensor. With
    names in `only`, both parts have these entries alone.

    Raises:
        ValueError: for an unknown name.
    """
    presets = {name: load_sensors(name) for name in shipped_sensors() if name != "perfect"}
    all_models = {**presets["tof-depth"].models, **presets["all"].models}
    models = {
        name: SensorSet(name, MappingProxyType({name: all_models[name]}))
        for name, sensor in SENSORS.items()
        if name in all_models and not sensor.measure
    }
    names = options.select({**presets, **models}, only, "preset or sensor model")
    return (
        {name: presets[name] for name in names if name in presets},
        {name: models[name] for name in names if name in models},
    )


def preset_grid(results: Sequence[ConditionResult]) -> Grid:
    """Return a table with a row for each preset and policy.

    It has the success rate at each level and over all levels, the change of the success rate
    against perfect sensors, and the speed.
    """
    base, rows = results[0], []
    levels = list(dict.fromkeys(trial.difficulty for trial in next(iter(base.results.values()))))
    for entry in results:
        for name, trials in entry.results.items():
            row: list[str | Cell] = [entry.condition.name, name]
            for level in levels:
                success = [trial.success for trial in trials if trial.difficulty == level]
                row.append(percent(wilson(sum(success), len(success))))
            change = entry.minus(base, name)
            speed, base_speed = entry.median(name, "v_mean"), base.median(name, "v_mean")
            is_perfect = entry.condition.sensors == PERFECT
            row += [percent(entry.success(name)), "" if is_perfect else difference_cell(change)]
            row.append(f"{speed:.2f} ({speed / base_speed - 1:+.1%})")
            rows.append(row)
    headers = ["sensors", "policy", *(f"level {level}" for level in levels)]
    return table([*headers, "all", "change", "v_mean [m/s]"], rows)


def gain_grids(results: Sequence[ConditionResult]) -> list[Grid]:
    """Return a table with the differences of the other policies to the first under each preset.

    The list is empty if there is one policy only.
    """
    first, *others = results[0].results
    rows = []
    for entry in results:
        cells = []
        for name in others:
            change = difference_cell(entry.minus(entry, name, first))
            speed_change = entry.median(name, "v_mean") / entry.median(first, "v_mean") - 1
            cells.append(Cell(f"{change.text}, {speed_change:+.1%}", change.tone))
        rows.append([entry.condition.name, *cells])
    title = f"Success in points and median v_mean against {first}, on the same trials"
    return [table(["sensors", *others], rows, title)] if others else []


def magnitude_grid(sweeps: Mapping[Sweep, Sequence[ConditionResult]]) -> Grid:
    """Return a table of success rate and speed at every magnitude.

    It has a row for each policy with each preset or model.
    """
    rows = []
    for sweep, points in sweeps.items():
        for name in points[0].results:
            cells = (
                f"{percent(p.success(name))}, {p.median(name, 'v_mean'):.2f} m/s" for p in points
            )
            rows.append([sweep.name, name, *cells])
    magnitudes = next(iter(sweeps)).sizes
    headers = ["sensors", "policy", *(f"x {size:g}" for size in magnitudes)]
    return table(headers, rows, "Success with its 95 % interval, and the median of v_mean")

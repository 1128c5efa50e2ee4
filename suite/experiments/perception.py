"""Success and speed through sensor models: each preset, and each model as its magnitude grows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np

from eval.judging.statistics import paired_success, wilson
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
from eval.vehicles.vehicle import Vehicle
from suite.common.console import Console
from suite.common.report import Picture
from suite.experiments.pages.document import Made
from suite.experiments.study import disturbed, judging, options
from suite.experiments.study.cache import Place
from suite.experiments.study.conditions import Condition, Sweep, sweep_conditions
from suite.experiments.study.disturbed import Tested
from suite.loop.compare import difference_cell
from tracks.common.grid import Cell, Grid, table
from tracks.input.ranges import Trials

PRESET_MAGNITUDES = (0.0, 0.5, 1.0, 1.5, 2.0)
"""Factors of the magnitudes in the shipped files, for a whole preset."""
MODEL_MAGNITUDES = (0.0, 1.0, 2.0)
"""The same for one sensor model alone."""


@dataclass(frozen=True)
class Config(options.Judged):
    """Judge policies through sensor models: all presets on every cell, and growing magnitudes.

    All policies fly the same trials under every condition. Give a policy that was trained with
    sensor models as the second one to see the effect of that training. Models alone, one at a
    time, are flown by the first policy only.
    """

    difficulty: str = "0,3,6,9"
    """Levels of the table of presets: 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials = 50
    """Trials of every policy on every track at every level through every preset."""
    growing_trials: Trials = 32
    """Trials of a policy on every track at level 3 at every magnitude."""
    only: tuple[str, ...] = ()
    """Only these presets and models, by name; all by default."""


def document(config: Config, place: Place, console: Console) -> Made:
    """Return tables and numbers; what is missing is flown first."""
    from suite.experiments.pages.charts import sweeps_chart

    vehicle, presets, models = load_vehicle(config.vehicle), *chosen_sets(config.only)
    policies = judging.named_policies(config.policy)
    cells, growing = judging.trials_of(config), replace(config, trials=config.growing_trials)
    base = Condition("perfect", 0.0, "", vehicle)
    usual = [Condition(name, 1.0, "", vehicle, sensors) for name, sensors in presets.items()]
    tested, _ = disturbed.flown_under([base, *usual], {}, policies, cells, place, console)
    again = judging.trials_of(growing, [3])

    def grown_under(
        sets: Mapping[str, SensorSet], magnitudes: Sequence[float], policies: Mapping[str, str]
    ) -> disturbed.Grown:
        sweeps = growing_sweeps(sets, magnitudes)
        conditions = {sweep: sweep_conditions(vehicle, sweep) for sweep in sweeps}
        return disturbed.flown_under([], conditions, policies, again, place, console)[1]

    first_policy = dict([next(iter(policies.items()))])
    grown_presets = grown_under(presets, PRESET_MAGNITUDES, policies)
    grown_models = grown_under(models, MODEL_MAGNITUDES, first_policy)
    facts = {
        **judging.policy_facts(policies),
        "presets": f"three tracks, levels {config.difficulty}, seeds "
        f"{options.judged_seeds(config)}: {len(cells)} trials a preset, the same in all",
        "magnitudes": f"three tracks, level 3, seeds {options.judged_seeds(growing)}: "
        f"{len(again)} trials a magnitude",
        "vehicle": config.vehicle,
    }
    parts: dict[str, list[Grid | Picture]] = {
        "Presets on every cell": [preset_grid(tested), *gain_grids(tested)],
    }
    for title, points in (
        ("Presets of growing magnitude", grown_presets),
        ("Single models of growing magnitude", grown_models),
    ):
        if points:
            chart = Picture(sweeps_chart(points), "Success against the magnitude of each")
            parts[title] = [chart, magnitude_grid(points)]
    numbers = [
        disturbed.tested_numbers(entry, entries[0])
        for entries in (tested, *grown_presets.values(), *grown_models.values())
        for entry in entries
    ]
    return Made(facts, parts, {"conditions": numbers})


def chosen_sets(only: Sequence[str]) -> tuple[dict[str, SensorSet], dict[str, SensorSet]]:
    """Return the presets, and each model alone at its usual size: those in `only`, or all.

    Raises:
        ValueError: for an unknown name.
    """
    presets = {name: load_sensors(name) for name in shipped_sensors() if name != "perfect"}
    usual = {**presets["tof-depth"].models, **presets["all"].models}
    models = {
        name: SensorSet(name, MappingProxyType({name: usual[name]}))
        for name, sensor in SENSORS.items()
        if name in usual and not sensor.measure
    }
    names = options.chosen({**presets, **models}, only, "preset or sensor model")
    return (
        {name: presets[name] for name in names if name in presets},
        {name: models[name] for name in names if name in models},
    )


def growing_sweeps(sets: Mapping[str, SensorSet], magnitudes: Sequence[float]) -> list[Sweep]:
    """Return a sweep over `magnitudes` (times the usual) of each of `sets`."""

    def at(sensors: SensorSet, vehicle: Vehicle, size: float) -> tuple[Vehicle, SensorSet]:
        return vehicle, scale_sensors(sensors, size)

    return [
        Sweep(name, "magnitude, times the usual", magnitudes, partial(at, sensors))
        for name, sensors in sets.items()
    ]


def _speed(entry: Tested, policy: str) -> float:
    """Return the median of the trials' mean speeds [m/s]."""
    return float(np.median([row.v_mean for row in entry.results[policy]]))


def preset_grid(tested: Sequence[Tested]) -> Grid:
    """Return a row a preset: success by level and over all, its change from perfect, speed."""
    base, lines = tested[0], []
    levels = list(dict.fromkeys(row.difficulty for row in next(iter(base.results.values()))))
    for entry in tested:
        for name, rows in entry.results.items():
            line: list[str | Cell] = [entry.condition.name, name]
            for level in levels:
                won = [row.success for row in rows if row.difficulty == level]
                line.append(percent(wilson(sum(won), len(won))))
            change = paired_success(entry.won(name), base.won(name))
            speed, before = _speed(entry, name), _speed(base, name)
            same = entry.condition.sensors == PERFECT
            line += [percent(entry.success(name)), "" if same else difference_cell(change)]
            line.append(f"{speed:.2f} ({speed / before - 1:+.1%})")
            lines.append(line)
    headers = ["sensors", "policy", *(f"level {level}" for level in levels)]
    return table([*headers, "all", "change", "v_mean [m/s]"], lines)


def gain_grids(tested: Sequence[Tested]) -> list[Grid]:
    """Return the differences of the other policies to the first under each preset."""
    first, *others = tested[0].results
    lines = []
    for entry in tested:
        cells = []
        for name in others:
            change = difference_cell(paired_success(entry.won(name), entry.won(first)))
            faster = _speed(entry, name) / _speed(entry, first) - 1
            cells.append(Cell(f"{change.text}, {faster:+.1%}", change.tone))
        lines.append([entry.condition.name, *cells])
    title = f"Success in points and median v_mean against {first}, on the same trials"
    return [table(["sensors", *others], lines, title)] if others else []


def magnitude_grid(grown_points: Mapping[Sweep, Sequence[Tested]]) -> Grid:
    """Return success and speed at every magnitude, a row for each set and policy."""
    lines = []
    for sweep, points in grown_points.items():
        for name in points[0].results:
            cells = (f"{percent(p.success(name))}, {_speed(p, name):.2f} m/s" for p in points)
            lines.append([sweep.name, name, *cells])
    magnitudes = next(iter(grown_points)).sizes
    headers = ["sensors", "policy", *(f"x {size:g}" for size in magnitudes)]
    return table(headers, lines, "Success with its 95 % interval, and the median of v_mean")

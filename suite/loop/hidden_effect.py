"""The loop with an effect that the simulation lacks: it is diagnosed, and trained for.

Only the judge reads the hidden vehicle's file. The simulation is corrected from measured flights
alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from eval.effects import EFFECTS
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle
from eval.worlds import differences
from eval.worlds.trial import TrialResult
from suite.common import curve
from suite.common.charts import curves_chart
from suite.common.report import Links, Picture, Section
from suite.diagnose.report.summary import components, grid
from suite.loop.charts import SEVERAL, success_chart
from suite.loop.compare import BEFORE, points, significance
from suite.loop.config import OWN, HiddenLoopConfig, LoopConfig
from suite.loop.report import errors_row
from suite.loop.standings import Standing, cell_grid, overall_grid, standings
from suite.loop.variants import DeltaModel, Findings, Loop, Shown, Variant
from suite.loop.work import named_effects, read_diagnosis
from tracks.common.files import to_json
from tracks.common.grid import table

NOMINAL, CONTROL, DELTA, NAMED, BOTH = "nominal", "control", "delta", "named", "both"
LABELS = {
    NOMINAL: "before, nothing hidden",
    BEFORE: "before",
    CONTROL: "control",
    DELTA: "with delta",
    NAMED: "with the named effect",
    BOTH: "with both",
}
"""Labels of the policies in tables."""
REFERENCES = (BEFORE, CONTROL, NOMINAL)
"""Policies that the others are compared with."""
MODELS = {CONTROL: "simulation's", NAMED: "corrected"}
"""Variants with a Delta Action Model in delta-NAME/, and the quadrotor that it corrects."""
JUDGED = "judging the one fine-tuned {}, on the same seeds"


def find(config: LoopConfig, out: Path, results: Mapping[str, Sequence[TrialResult]]) -> Findings:
    """Return the results of the finished loop in `out`."""
    assert isinstance(config, HiddenLoopConfig)
    diagnosis, trials = read_diagnosis(out), config.trials * config.cells
    stand = standings(results, REFERENCES)
    kept = ("verdict", "effects", "gap", "unexplained")
    return Findings(
        verdict=verdict(stand, diagnosis, trials, place(config)),
        tables=[overall_grid(stand, REFERENCES, LABELS, trials), cell_grid(stand, LABELS)],
        errors=[
            f"Delta Action Model of the {whose} quadrotor\n\n"
            + (out / f"delta-{name}" / "table.md").read_text(encoding="utf-8")
            for name, whose in MODELS.items()
            if config.delta
        ],
        numbers={"standings": stand, "diagnosis": {key: diagnosis[key] for key in kept}},
        facts={
            "tracks": config.track,
            "levels": config.difficulty,
            "simulation's vehicle": config.vehicle,
            "hidden vehicle": config.hidden_vehicle,
            "flown in": config.simulator,
        },
        chart=Picture(success_chart(stand, LABELS), "Bars: 95 % intervals over trials."),
        sections=[
            _diagnosis(config, diagnosis),
            *([_delta(out)] if config.delta else []),
            _training(out, config),
        ],
    )


def place(config: HiddenLoopConfig) -> str:
    """Return the name of the hidden vehicle in sentences."""
    return "the hidden vehicle" if config.simulator in OWN else f"the simulator {config.simulator}"


def verdict(
    stand: Sequence[Standing],
    diagnosis: Mapping[str, Any],
    trials: int,
    where: str = "the hidden vehicle",
) -> str:
    """Return the loop's result in a few sentences; `where` names the judged vehicle."""
    by_name = {one.name: one for one in stand}
    apart = {other.against: other.success for other in by_name[NAMED].differences}

    def percent(name: str) -> str:
        return f"{100 * by_name[name].success.value:.0f} %"

    lost = apart[NOMINAL]
    back = (
        "above"
        if lost.low > 0
        else "below"
        if lost.high < 0
        else "not significantly different from"
    )
    text = (
        f"With {where} {percent(BEFORE)} of {trials} trials succeed, with the simulation's "
        f"vehicle {percent(NOMINAL)}. The diagnosis names {named_effects(diagnosis)}. Fine-tuned "
        f"with it, {percent(NAMED)} succeed there: {significance(apart[CONTROL])} the "
        f"same fine-tuning without it ({percent(CONTROL)}; difference {points(apart[CONTROL])}), "
        f"and {back} the policy where nothing is hidden (difference {points(lost)})."
    )
    if DELTA not in by_name:
        return text
    return (
        f"{text} With the Delta Action Model instead {percent(DELTA)} succeed, "
        f"with both {percent(BOTH)}."
    )


def _diagnosis(config: HiddenLoopConfig, diagnosis: Mapping[str, Any]) -> Section:
    gap = diagnosis["gap"]
    rows = [
        (effect["name"], ", ".join(effect["alternatives"]), one.label, *one.texts())
        for effect in diagnosis["effects"]
        for one in components(effect)
    ]
    headers = ["effect", "or", "parameter", "value", "95 %"]
    return Section(
        "What the diagnosis found in the flights",
        [
            f"Verdict: {diagnosis['verdict']}. Held-out gap {gap['before']:.2f} before, "
            f"{gap['after']:.2f} after; {gap['noise_floor']:.2g} is the noise floor.",
            grid("", headers, rows),
            *what_is_hidden(config),
            Links([("diagnosis/report.html", "the diagnosis's own report")]),
        ],
    )


def what_is_hidden(config: HiddenLoopConfig) -> list[str]:
    """Return sentences on the differences of the hidden vehicle to the simulation's."""
    simulated, true = load_vehicle(config.vehicle), load_vehicle(config.hidden_vehicle)
    more = hidden_effects(simulated, true)
    hidden = [f"What the hidden vehicle's file holds and the simulation's does not: {more}."]
    if simulated == true:
        hidden = ["The hidden vehicle's file is the simulation's."]
    if config.simulator not in OWN:
        otherwise = "; ".join(differences(config.simulator, true)) or "nothing"
        hidden.append(f"What {config.simulator} flies otherwise than the file says: {otherwise}.")
    return hidden


def hidden_effects(simulated: Vehicle, true: Vehicle) -> str:
    """Return the effects of `true` that `simulated` lacks or has with other values, as text."""
    parts = []
    for name, value in true.effects.items():
        if simulated.effects.get(name) != value:
            held = (
                f"{parameter.name} {to_json(getattr(value, parameter.name))} {parameter.unit}"
                for parameter in EFFECTS[name].parameters
            )
            parts.append(f"{name} ({', '.join(held)})")
    parts += [f"no {name}" for name in simulated.effects if name not in true.effects]
    if replace(true, name=simulated.name, effects=simulated.effects) != simulated:
        parts.append("other nominal values")
    return "; ".join(parts)


def _delta(out: Path) -> Section:
    rows = []
    for variant, whose in MODELS.items():
        text = (out / f"delta-{variant}" / "delta.json").read_text(encoding="utf-8")
        fitted = json.loads(text)
        rows.append(errors_row(f"{whose} vehicle", fitted["without"]))
        rows.append(errors_row(f"{whose} vehicle with delta", fitted["delta_action"]))
    headers = ["held-out flights, after 1 s", "position error [m]", "velocity error [m/s]"]
    words = (
        "Recorded actions are flown again through the differentiable quadrotor; the flights are "
        "as measured, so the noise of the start is in every row. The diagnosis, which corrected "
        "the vehicle, has seen some of these flights; no Delta Action Model has."
    )
    return Section("Delta Action Models on held-out flights", [words, table(headers, rows)])


def _training(out: Path, config: LoopConfig) -> Section:
    assert isinstance(config, HiddenLoopConfig)
    tuned = (CONTROL, DELTA, NAMED, BOTH) if config.delta else (CONTROL, NAMED)
    curves = {LABELS[name]: curve.read(out / f"tuned-{name}") for name in tuned}
    chart = curves_chart(curves, SEVERAL[2:])
    words = (
        f"{config.tuning.optimizer.iterations} iterations each, from {config.policy}. Each curve "
        "is of the vehicle that it was trained in, so their levels are not comparable."
    )
    return Section("Fine-tuning", [words, Picture(chart, "Thin: each step. Thick: means.")])


LOOP = Loop(
    title="A hidden effect, named and trained for",
    hidden=True,
    variants=(
        Variant(NOMINAL, "judging the policy in the simulation's vehicle", simulated=True),
        Variant(BEFORE, "judging the policy with the hidden vehicle"),
        Variant(
            CONTROL,
            JUDGED.format("as the control"),
            "through the simulation's vehicle, as the control",
        ),
        Variant(
            DELTA,
            JUDGED.format("with the Delta Action Model"),
            "through the simulation's vehicle and the frozen Delta Action Model",
            delta="delta-control",
        ),
        Variant(
            NAMED,
            JUDGED.format("with the named effect"),
            "through the corrected vehicle",
            diagnosed=True,
        ),
        Variant(
            BOTH,
            JUDGED.format("with both"),
            "through the corrected vehicle and the frozen Delta Action Model of what it lacks",
            delta="delta-named",
            diagnosed=True,
        ),
    ),
    models=tuple(
        DeltaModel(
            f"delta-{name}",
            f"fitting the Delta Action Model of the {whose} quadrotor",
            diagnosed=name == NAMED,
        )
        for name, whose in MODELS.items()
    ),
    shown=(
        Shown(BEFORE, "before fine-tuning", "Flights before fine-tuning"),
        Shown(
            NAMED, "fine-tuned with the named effect", "Flights fine-tuned with the named effect"
        ),
    ),
    find=find,
    reading="The first policy flies in the simulation's vehicle and with the hidden vehicle; the "
    "others are fine-tuned from it, for as many iterations on the same random tracks, and fly in "
    "the hidden vehicle on the same trials. The control is fine-tuned through the simulation's "
    "quadrotor as it is, the others through it with its Delta Action Model, through the quadrotor "
    "corrected by the named effect, and through that with a Delta Action Model of what it still "
    "lacks. The judge flies the policies alone.",
    caveat="Intervals are 95 % over trials, for these policies: another seed of the fine-tuning "
    "gives other policies. Differences are taken trial by trial.",
    advice="record more (--flights), with another --out",
    files=(
        ("table.md", "the tables on this page"),
        ("loop.json", "the same as numbers, with the configuration"),
        ("diagnosis/report.html", "the report of the diagnosis"),
        ("diagnosis/vehicle.toml", "the corrected vehicle file"),
        ("recording.rrd", "trials before and after, for rerun"),
        ("flights/flights.json", "the recorded flights"),
        ("measured/measured.json", "the same as measured"),
        ("tuned-named/policy/config.json", "the policy tuned with the named effect"),
    ),
)

WITHOUT_DELTA = replace(
    LOOP,
    variants=[variant for variant in LOOP.variants if variant.delta is None],
    models=(),
    reading="The first policy flies in the simulation's vehicle and with the hidden vehicle; the "
    "others are fine-tuned from it, for as many iterations on the same random tracks, and fly in "
    "the hidden vehicle on the same trials. The control is fine-tuned through the simulation's "
    "quadrotor as it is, the other through the quadrotor corrected by the named effect.",
)
"""The loop without Delta Action Models, which takes half the time."""

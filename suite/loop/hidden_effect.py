"""The loop with a hidden vehicle: its effect is diagnosed, and policies are fine-tuned for it.

Only the judge reads the file of the hidden vehicle; the simulation is corrected from measured
flights only. Six policies are compared. `NOMINAL` and `BEFORE` are the first policy, with the
vehicle of the simulation and with the hidden one. The others are fine-tuned and fly the hidden
vehicle: `CONTROL` in the uncorrected simulation, `DELTA` with a Delta Action Model, `NAMED` with
the effect that the diagnosis names, `BOTH` with that effect and a Delta Action Model.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from eval.effects import EFFECTS
from eval.judging.statistics import Interval
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle
from eval.worlds import differences
from suite.common import curve
from suite.common.charts import curves_chart
from suite.common.report import Links, Picture, Section
from suite.delta.run import errors_grid
from suite.diagnose.report.summary import components, figure
from suite.loop.compare import BEFORE, PolicyResult, points, significance
from suite.loop.config import EXACT_SIMULATORS, LoopConfig
from suite.loop.variants import COLOURS, DeltaModel, Findings, Loop, ShownPolicy, Variant
from suite.loop.work import named_effects, read_diagnosis
from tracks.common.figures import with_unit
from tracks.common.files import to_json
from tracks.common.grid import markdown, table

NOMINAL, CONTROL, DELTA, NAMED, BOTH = "nominal", "control", "delta", "named", "both"
LABELS = {
    NOMINAL: "before, no hidden effect",
    BEFORE: "before",
    CONTROL: "control",
    DELTA: "with delta",
    NAMED: "with the named effect",
    BOTH: "with both",
}
"""Labels of the policies in tables."""
REFERENCES = (BEFORE, CONTROL, NOMINAL)
"""Policies with which the others are compared."""
MODELS = {CONTROL: "simulation's", NAMED: "corrected"}
"""Delta Action Models: the model in delta-NAME/ is fitted to the dynamics in which the policy NAME
is fine-tuned. The text names the quadrotor of these dynamics."""
DELTA_TITLE = "Delta Action Models on held-out flights"
DELTA_TEXT = (
    "Recorded actions are flown again through the differentiable quadrotor. The flights have "
    "measurement noise, so the noise of the start is in every row. The diagnosis, which "
    "corrected the vehicle, used some of these flights; no fit of a Delta Action Model did."
)
"""Heading and explanation of the errors of the Delta Action Models."""
JUDGED = "judging the one fine-tuned {}, on the same seeds"
"""Description of the judging of a fine-tuned policy."""


def summarise(config: LoopConfig, out: Path, policies: Sequence[PolicyResult]) -> Findings:
    """Return the results of the finished loop in `out`."""
    diagnosis, trials = read_diagnosis(out), config.trials * config.cells
    fits = _fits(out) if config.delta else {}
    errors = [
        errors_grid(fit, f"Delta Action Model of the {MODELS[name]} quadrotor")
        for name, fit in fits.items()
    ]
    keys = ("verdict", "effects", "gap", "unexplained")
    return Findings(
        verdict=verdict(policies, diagnosis, trials, vehicle_phrase(config)),
        errors=[*map(markdown, errors)],
        numbers={
            "diagnosis": {key: diagnosis[key] for key in keys},
            **({"delta": fits} if fits else {}),
        },
        facts={
            "simulation's vehicle": config.vehicle,
            "hidden vehicle": config.true_vehicle,
            "flown in": config.simulator,
        },
        sections=[
            _diagnosis_section(config, diagnosis),
            *([Section(DELTA_TITLE, [DELTA_TEXT, *errors])] if errors else []),
            _training_section(out, config),
        ],
    )


def vehicle_phrase(config: LoopConfig) -> str:
    """Return how sentences name what differs from the simulation: the vehicle, or the simulator."""
    if config.simulator in EXACT_SIMULATORS:
        return "the hidden vehicle"
    return f"the simulator {config.simulator}"


def verdict(
    policies: Sequence[PolicyResult],
    diagnosis: Mapping[str, Any],
    trials: int,
    vehicle: str = "the hidden vehicle",
) -> str:
    """Return the loop's result in a few sentences; `vehicle` is how they name the true vehicle."""
    by_name = {policy.name: policy for policy in policies}

    def minus(name: str) -> dict[str, Interval]:
        return {other.against: other.success for other in by_name[name].differences}

    def percent(name: str) -> str:
        return f"{100 * by_name[name].success.value:.0f} %"

    to_control, to_nominal = (minus(NAMED)[name] for name in (CONTROL, NOMINAL))
    text = (
        f"With {vehicle} {percent(BEFORE)} of {trials} trials succeed, with the simulation's "
        f"vehicle {percent(NOMINAL)}. The diagnosis names {named_effects(diagnosis)}. Fine-tuned "
        f"with it, {percent(NAMED)} succeed there: {significance(to_control)} the "
        f"same fine-tuning without it ({percent(CONTROL)}; difference {points(to_control)}), "
        f"and {significance(to_nominal, 'above', 'below')} the policy where nothing is hidden "
        f"(difference {points(to_nominal)})."
    )
    lost = minus(NOMINAL)[BEFORE]
    if lost.high < 0.0:
        text += (
            " The policy flies the hidden vehicle better than the simulation's: perhaps --vehicle "
            "and --hidden-vehicle are swapped."
        )
    elif lost.low <= 0.0:
        text += (
            " The hidden effect does not lower the success rate significantly here, so there is "
            "nothing to regain: raise --difficulty or --trials."
        )
    if DELTA not in by_name:
        return text
    return (
        f"{text} With the Delta Action Model instead {percent(DELTA)} succeed, "
        f"with both {percent(BOTH)}."
    )


def _diagnosis_section(config: LoopConfig, diagnosis: Mapping[str, Any]) -> Section:
    """Return the section with the result of the diagnosis, and with what is hidden in truth."""
    gap = diagnosis["gap"]
    rows = [
        (
            effect["name"],
            ", ".join(effect["alternatives"]),
            component.label,
            component.file_text,
            *component.texts(),
        )
        for effect in diagnosis["effects"]
        for component in components(effect)
    ]
    headers = ["effect", "or", "parameter", "vehicle file", "value", "95 %"]
    return Section(
        "What the diagnosis found in the flights",
        [
            f"Verdict: {diagnosis['verdict']}. The gap (error) on held-out flights is "
            f"{figure(gap['before'])} {gap['unit']} before, {figure(gap['after'])} after; "
            f"{gap['noise_floor']:.3g} is the noise floor.",
            table(headers, rows),
            *describe_hidden(config),
            Links([("diagnosis/report.html", "the diagnosis's own report")]),
        ],
    )


def describe_hidden(config: LoopConfig) -> list[str]:
    """Return sentences on the differences between the hidden vehicle and that of the simulation."""
    simulated, true = load_vehicle(config.vehicle), load_vehicle(config.true_vehicle)
    effects = hidden_effects(simulated, true)
    sentences = [f"Differences of the hidden vehicle's file to the simulation's: {effects}."]
    if not effects:
        sentences = ["The hidden vehicle's file is that of the simulation."]
    if config.simulator not in EXACT_SIMULATORS:
        listed = "; ".join(differences(config.simulator, true)) or "none"
        sentences.append(f"Differences of {config.simulator} to the vehicle file: {listed}.")
    return sentences


def hidden_effects(simulated: Vehicle, true: Vehicle) -> str:
    """Return the differences of the vehicle `true` to the vehicle `simulated`, as text.

    They are effects that one of them lacks or that have other values; then other nominal values.
    """
    texts = []
    for name, value in true.effects.items():
        if simulated.effects.get(name) != value:
            values = (
                with_unit(f"{p.name} {to_json(getattr(value, p.name))}", p.unit)
                for p in EFFECTS[name].parameters
            )
            texts.append(f"{name} ({', '.join(values)})")
    texts += [f"no {name}" for name in simulated.effects if name not in true.effects]
    if replace(true, name=simulated.name, effects=simulated.effects) != simulated:
        texts.append("other nominal values")
    return "; ".join(texts)


def _fits(out: Path) -> dict[str, dict[str, Any]]:
    """Return the contents of delta.json of each Delta Action Model, without the learning curve."""
    fits = {}
    for name in MODELS:
        fits[name] = json.loads((out / f"delta-{name}" / "delta.json").read_text(encoding="utf-8"))
        fits[name].pop("curve", None)
    return fits


def _training_section(out: Path, config: LoopConfig) -> Section:
    """Return the section with the learning curves of the fine-tunings."""
    tuned = (CONTROL, DELTA, NAMED, BOTH) if config.delta else (CONTROL, NAMED)
    curves = {LABELS[name]: curve.read(out / f"tuned-{name}") for name in tuned}
    chart = curves_chart(curves, COLOURS[2:])
    text = (
        f"{config.tuning.optimizer.iterations} iterations each, from {config.policy}. Each policy "
        "was trained in other dynamics, so the levels of the curves are not comparable."
    )
    return Section("Fine-tuning", [text, Picture(chart, "Thin: each step. Thick: means.")])


READING = (
    "The first policy flies the simulation's vehicle and the hidden vehicle. The others are "
    "fine-tuned from it, for the same number of iterations on the same random tracks, and fly the "
    "hidden vehicle on the same trials. The control is fine-tuned through the simulation's "
)
"""Beginning of the explanation of the tables."""

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
            f"fitting the Delta Action Model of the {quadrotor} quadrotor",
            diagnosed=name == NAMED,
        )
        for name, quadrotor in MODELS.items()
    ),
    shown=(
        ShownPolicy(BEFORE, "before fine-tuning", "Flights before fine-tuning"),
        ShownPolicy(
            NAMED,
            "fine-tuned with the named effect",
            "Flights after fine-tuning with the named effect",
        ),
    ),
    labels=LABELS,
    references=REFERENCES,
    summarise=summarise,
    reading=f"{READING}quadrotor; the others through it with its Delta Action Model, through the "
    "quadrotor corrected by the named effect, and through the latter with a Delta Action Model of "
    "its remaining error. The judge flies the policies without a Delta Action Model.",
    advice="record more (--flights), with another --out",
    files=(
        ("table.md", "the tables on this page"),
        ("loop.json", "the same as numbers, with the configuration"),
        ("diagnosis/report.html", "the report of the diagnosis"),
        ("diagnosis/vehicle.toml", "the corrected vehicle file"),
        ("recording.rrd", "trials before and after, for rerun"),
        ("flights/flights.json", "the recorded flights"),
        ("measured/measured.json", "the same flights with measurement noise"),
        ("tuned-named/policy/config.json", "the policy tuned with the named effect"),
    ),
)

WITHOUT_DELTA = replace(
    LOOP,
    variants=[variant for variant in LOOP.variants if variant.delta is None],
    models=(),
    reading=f"{READING}quadrotor, the other policy through the quadrotor corrected by the named "
    "effect.",
)
"""The loop without Delta Action Models, which takes half the time."""

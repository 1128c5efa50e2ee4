"""The loop that shows the effect of a Delta Action Model ("delta") on the fine-tuning of a policy.

One policy is fine-tuned with it. Another one, the control, is fine-tuned without it for the same
number of steps, and shows the effect of more training alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from suite.common import curve
from suite.common.charts import curves_chart, legend, png, titled
from suite.common.report import Picture, Section
from suite.delta.run import errors_by_name, errors_grid
from suite.loop.compare import BEFORE, PolicyResult, points, significance
from suite.loop.config import LoopConfig
from suite.loop.variants import COLOURS, DeltaModel, Findings, Loop, ShownPolicy, Variant
from tracks.common.grid import markdown

WITHOUT, WITH = "without", "with"
LABELS = {BEFORE: "before", WITHOUT: "tuned without delta", WITH: "tuned with delta"}
"""Labels of the policies in tables."""
REFERENCES = (BEFORE, WITHOUT)
"""Policies with which the others are compared."""
JUDGED = "judging the one fine-tuned {} the Delta Action Model, on the same seeds"
"""Description of the judging of a fine-tuned policy."""


def summarise(config: LoopConfig, out: Path, policies: Sequence[PolicyResult]) -> Findings:
    """Return the results of the finished loop in `out`."""
    fitted = json.loads((out / "delta" / "delta.json").read_text(encoding="utf-8"))
    return Findings(
        verdict=verdict(policies, config.trials * config.cells),
        errors=[markdown(errors_grid(fitted))],
        numbers={"delta": {key: value for key, value in fitted.items() if key != "curve"}},
        facts={"vehicle": config.vehicle},
        sections=[_delta_section(fitted), _training_section(out, config)],
    )


def verdict(policies: Sequence[PolicyResult], trials: int) -> str:
    """Return a sentence on the effect of fine-tuning with the Delta Action Model."""
    by_name = {policy.name: policy for policy in policies}
    to_control = {other.against: other.success for other in by_name[WITH].differences}[WITHOUT]

    def percent(name: str) -> str:
        return f"{100 * by_name[name].success.value:.0f} %"

    return (
        f"Fine-tuned with the Delta Action Model, {percent(WITH)} of {trials} trials succeed: "
        f"{significance(to_control)} the same fine-tuning without it ({percent(WITHOUT)}; "
        f"difference {points(to_control)}); before, {percent(BEFORE)}."
    )


def _delta_section(fitted: Mapping) -> Section:
    """Return the section with the errors on held-out flights; `fitted` is from delta.json."""
    corrected = f"quadrotor of {fitted['vehicle']['name']}" if "vehicle" in fitted else "point mass"
    windows, held, horizon = fitted["windows"], len(fitted["held_out"]), fitted["horizon_s"]
    return Section(
        "Delta Action Model on held-out flights",
        [
            f"Recorded actions are flown again in the {corrected} for {horizon:g} s. "
            f"No fit used the {windows['held_out']} windows of the held-out flights ({held}). The "
            f"fit used {windows['fit']} windows of the other flights.",
            errors_grid(fitted),
            Picture(delta_chart(fitted), f"Mean distance from the record after {horizon:g} s."),
        ],
    )


def delta_chart(fitted: Mapping[str, Any]) -> bytes:
    """Return the chart of the Delta Action Model's error during its fit, and of simpler models.

    The simpler models have one error each, a horizontal line. `fitted` are the contents of
    delta.json.
    """
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    axes = figure.subplots()
    iterations = [row["iteration"] for row in fitted["curve"]]
    for key, label, style in (
        ("held_out_m", "with Delta Action Model, held-out flights", "-"),
        ("fit_m", "with Delta Action Model, fitted flights", ":"),
    ):
        errors = [row[key] for row in fitted["curve"]]
        axes.plot(iterations, errors, style, color=COLOURS[4], lw=1.8, label=label)
    # The last error is that of the Delta Action Model after the fit, the end of its curve.
    *simpler, _ = errors_by_name(fitted).items()
    for (name, error), colour in zip(simpler, COLOURS, strict=False):
        label = f"{name}, held-out flights"
        axes.axhline(error["position_m"], color=colour, lw=1.8, label=label)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("iteration of the fit", fontsize=9)
    titled(axes, f"Position error after {fitted['horizon_s']:g} s [m]")
    legend(figure, axes, 2, 8)
    return png(figure)


def _training_section(out: Path, config: LoopConfig) -> Section:
    """Return the section with the learning curves of the training and the fine-tunings."""
    folders = {BEFORE: "train", WITHOUT: "tuned-without", WITH: "tuned-with"}
    labels = {**LABELS, BEFORE: "training"}
    curves = {labels[name]: curve.read(out / folder) for name, folder in folders.items()}
    chart = curves_chart(curves, COLOURS, follow=True)
    first = f"{config.training.optimizer.iterations} iterations of training, then "
    if config.policy:
        first = f"From {config.policy}: "
    text = (
        f"{first}{config.tuning.optimizer.iterations} iterations of fine-tuning, without and with "
        "the frozen Delta Action Model. Each policy was trained in other dynamics, on random "
        "tracks, so the levels of the two fine-tunings are not comparable."
    )
    return Section("Training", [text, Picture(chart, "Thin: each iteration. Thick: means.")])


LOOP = Loop(
    title="Delta Action Model, with and without",
    hidden=False,
    variants=(
        Variant(BEFORE, "judging the policy in MuJoCo"),
        Variant(WITHOUT, JUDGED.format(WITHOUT), "without it, as the control"),
        Variant(WITH, JUDGED.format(WITH), "under the frozen Delta Action Model", delta="delta"),
    ),
    models=(DeltaModel("delta", "fitting the Delta Action Model to the flights"),),
    shown=(
        ShownPolicy(BEFORE, "before", "Flights before fine-tuning"),
        ShownPolicy(WITH, "tuned with delta", "Flights after fine-tuning with delta"),
    ),
    labels=LABELS,
    references=REFERENCES,
    summarise=summarise,
    reading="All three policies fly the same trials in the MuJoCo quadrotor, without the Delta "
    "Action Model (delta). The policy tuned without delta is the control: it has the same number "
    "of iterations on the same tracks, in the uncorrected dynamics. A difference is coloured if "
    "its interval excludes zero.",
    advice="if the policy crashes within a second or two, train it for longer (--iterations), "
    "or record more flights (--flights), with another --out",
    files=(
        ("table.md", "the tables on this page"),
        ("loop.json", "the same as numbers, with the configuration"),
        ("recording.rrd", "trials before and after, for rerun"),
        ("eval-before/trials.parquet", "a row per trial, before"),
        ("eval-without/trials.parquet", "tuned without delta"),
        ("eval-with/trials.parquet", "tuned with delta"),
        ("flights/flights.json", "the recorded flights"),
        ("delta/delta/config.json", "the Delta Action Model"),
        ("tuned-with/policy/config.json", "the policy tuned with delta"),
        ("tuned-without/policy/config.json", "the policy tuned without delta"),
    ),
)

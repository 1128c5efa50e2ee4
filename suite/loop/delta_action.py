"""The loop that shows the effect of the Delta Action Model: fine-tuning with it and without.

The control is fine-tuned for as many steps, so that the effect of more training alone is visible.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from eval.worlds.trial import TrialResult
from suite.common import curve
from suite.common.report import Picture, Section
from suite.delta.run import errors_by_name
from suite.judging.requests import parse_tracks
from suite.loop.charts import comparison_chart, delta_chart, training_chart
from suite.loop.compare import BEFORE, CAVEAT, WITH, WITHOUT, compare, grids, verdict
from suite.loop.config import DeltaLoopConfig, LoopConfig
from suite.loop.report import errors_row
from suite.loop.variants import DeltaModel, Findings, Loop, Shown, Variant
from tracks.common.grid import table

JUDGED = "judging the one fine-tuned {} the Delta Action Model, on the same seeds"


def find(config: LoopConfig, out: Path, results: Mapping[str, Sequence[TrialResult]]) -> Findings:
    """Return the results of the finished loop in `out`."""
    assert isinstance(config, DeltaLoopConfig)
    lines = compare(results)
    fitted = json.loads((out / "delta" / "delta.json").read_text(encoding="utf-8"))
    return Findings(
        verdict=verdict(lines[-1]),
        tables=grids(lines),
        errors=[(out / "delta" / "table.md").read_text(encoding="utf-8")],
        numbers={
            "comparison": lines,
            "delta": {key: value for key, value in fitted.items() if key != "curve"},
        },
        facts={
            "tracks": ", ".join(parse_tracks(config.track)),
            "levels": config.difficulty,
            "vehicle": config.vehicle,
        },
        chart=Picture(comparison_chart(lines), "Bars: 95 % intervals over trials."),
        sections=[_delta(fitted), _training(out, config)],
    )


def _delta(fitted: Mapping) -> Section:
    errors = errors_by_name(fitted)
    base_m = next(iter(errors.values()))["position_m"]
    rows = [errors_row(name, error, base_m) for name, error in errors.items()]
    corrected = f"quadrotor of {fitted['vehicle']['name']}" if "vehicle" in fitted else "point mass"
    windows, held, horizon = fitted["windows"], len(fitted["held_out"]), fitted["horizon_s"]
    return Section(
        "Delta Action Model on held-out flights",
        [
            f"Recorded actions are flown again in the {corrected} for {horizon:g} s. "
            f"{held} flights ({windows['held_out']} windows) took no part in any fit; "
            f"{windows['fit']} windows of the others did.",
            table(["", "position error [m]", "velocity error [m/s]", "of the first"], rows),
            Picture(delta_chart(fitted), f"Mean distance from the record after {horizon:g} s."),
        ],
    )


def _training(out: Path, config: DeltaLoopConfig) -> Section:
    folders = {BEFORE: "train", WITHOUT: "tuned-without", WITH: "tuned-with"}
    chart = training_chart({name: curve.read(out / folder) for name, folder in folders.items()})
    first = f"{config.training.optimizer.iterations} iterations of training, then "
    if config.policy:
        first = f"From {config.policy}: "
    words = (
        f"{first}{config.tuning.optimizer.iterations} of fine-tuning, without and with the frozen "
        "Delta Action Model. The curves are of the dynamics each was trained in, on random tracks, "
        "so the two fine-tunings' levels are not comparable: with the model it is another vehicle."
    )
    return Section("Training", [words, Picture(chart, "Thin: each iteration. Thick: means.")])


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
        Shown(BEFORE, "before", "Flights before fine-tuning"),
        Shown(WITH, "tuned with delta", "Flights, fine-tuned with delta"),
    ),
    find=find,
    reading="All three policies fly the same trials in the MuJoCo quadrotor, without the Delta "
    "Action Model. Tuned without delta is the control: as many iterations on the same tracks, in "
    "the uncorrected dynamics. Coloured differences are those whose interval does not hold zero.",
    caveat=CAVEAT,
    advice="where the policy crashes within a second or two, train it for longer (--iterations), "
    "or record more flights (--flights), with another --out",
    files=(
        ("table.md", "the tables on this page"),
        ("loop.json", "the same as numbers, with the configuration"),
        ("recording.rrd", "trials before and after, for rerun"),
        ("eval-before/trials.parquet", "a row a trial, before"),
        ("eval-without/trials.parquet", "tuned without delta"),
        ("eval-with/trials.parquet", "tuned with delta"),
        ("flights/flights.json", "the recorded flights"),
        ("delta/delta/config.json", "the Delta Action Model"),
        ("tuned-with/policy/config.json", "the policy tuned with delta"),
        ("tuned-without/policy/config.json", "the policy tuned without delta"),
    ),
)

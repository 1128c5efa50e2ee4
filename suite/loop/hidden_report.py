"""What the report of a loop with a hidden effect shows."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle
from suite.common.console import duration
from suite.common.report import Cell, Details, Grid, Links, Picture, Report, Section, write_report
from suite.loop.charts import success_chart, tuning_chart
from suite.loop.hidden_config import HiddenConfig
from suite.loop.variants import Standing
from suite.train import curve
from tracks.common.files import to_json
from tracks.common.provenance import git_commit
from tracks.common.version import VERSION

NOMINAL, BEFORE = "nominal", "before"
CONTROL, DELTA, NAMED, BOTH = "control", "delta", "named", "both"
VARIANTS = (NOMINAL, BEFORE, CONTROL, DELTA, NAMED, BOTH)
"""What is compared, in the order of the tables."""
REFERENCES = (BEFORE, CONTROL, NOMINAL)
"""What the others are held against."""
LABELS = {
    NOMINAL: "before, nothing hidden",
    BEFORE: "before",
    CONTROL: "control",
    DELTA: "with delta",
    NAMED: "with the named effect",
    BOTH: "with both",
}
"""What tables call them."""
TITLES = {BEFORE: "before fine-tuning", NAMED: "fine-tuned with the named effect"}
"""Of the pictures."""
READING = (
    "The first policy flies in the simulation's vehicle and in the hidden world; the others are "
    "fine-tuned from it, for as many iterations on the same random tracks, and fly in the hidden "
    "world on the same trials. The control is fine-tuned through the simulation's quadrotor as it "
    "is, the others through it with its Delta Action Model, through the quadrotor corrected by the "
    "named effect, and through that with a Delta Action Model of what it still lacks. The judge "
    "flies the policies alone."
)
CAVEAT = (
    "Intervals are 95 % over trials, for these policies: another seed of the fine-tuning gives "
    "other policies. Differences are taken trial by trial."
)
"""What the intervals do not say."""
FILES = (
    ("table.md", "the tables on this page"),
    ("loop.json", "the same as numbers, with the configuration"),
    ("diagnosis/report.html", "how the diagnosis came to its answer"),
    ("diagnosis/vehicle.toml", "the corrected vehicle file"),
    ("recording.rrd", "trials before and after, for rerun"),
    ("flights/flights.json", "the recorded flights"),
    ("measured/measured.json", "the same as measured"),
    ("tuned-named/policy/config.json", "the policy tuned with the named effect"),
)


def named_effects(found: Mapping[str, Any]) -> str:
    """Return the effects that diagnosis.json names, with their rivals, in words."""
    parts = []
    for effect in found["effects"]:
        rivals = ", ".join(effect["alternatives"])
        parts.append(effect["name"] + (f" (or {rivals})" if rivals else ""))
    return ", ".join(parts)


def verdict(stand: Sequence[Standing], found: Mapping[str, Any], trials: int) -> str:
    """Return in a few sentences what the loop showed."""
    by = {one.name: one for one in stand}
    apart = {d.against: d.success for d in by[NAMED].differences}

    def percent(name: str) -> str:
        return f"{100 * by[name].success.value:.0f} %"

    def points(other: str) -> str:
        value, low, high = (round(100 * x) + 0.0 for x in apart[other])
        return f"{value:+.0f} points [{low:+.0f}, {high:+.0f}]"

    gained = "more than" if apart[CONTROL].low > 0 else "not to be told from"
    if apart[CONTROL].high < 0:
        gained = "fewer than"
    back = "not to be told from" if apart[NOMINAL].high >= 0 else "below"
    return (
        f"In the hidden world {percent(BEFORE)} of {trials} trials succeed, in the simulation's "
        f"vehicle {percent(NOMINAL)}. The diagnosis names {named_effects(found)}. Fine-tuned with "
        f"it, {percent(NAMED)} succeed in the hidden world: {gained} the same fine-tuning without "
        f"it ({percent(CONTROL)}; difference {points(CONTROL)}), and {back} the policy where "
        f"nothing is hidden (difference {points(NOMINAL)}). With the Delta Action Model instead "
        f"{percent(DELTA)} succeed, with both {percent(BOTH)}."
    )


def write_hidden_report(
    path: Path,
    config: HiddenConfig,
    stand: Sequence[Standing],
    tables: Sequence[Grid],
    found: Mapping[str, Any],
    seconds: Mapping[str, float],
) -> None:
    """Write the report of the finished loop in the folder of `path`.

    Args:
        path: report.html.
        config: of the loop.
        stand: as `suite.loop.variants.standings` gives them.
        tables: of them.
        found: what diagnosis.json holds.
        seconds: how long each stage took [s].
    """
    out, trials = path.parent, config.trials * config.cells
    report = Report(
        title="A hidden effect, named and trained for",
        lead=verdict(stand, found, trials),
        facts={
            "trials": f"{trials} of each policy",
            "tracks": config.track,
            "levels": config.difficulty,
            "simulation's vehicle": config.vehicle,
            "hidden world": config.world,
            "started from": config.policy,
            "seed": str(config.seed),
            "version": f"{VERSION}, {(git_commit() or 'no commit')[:10]}",
        },
        sections=[
            Section(
                "On the same seeds",
                [
                    READING,
                    Picture(success_chart(stand, LABELS), "Bars: 95 % intervals over trials."),
                    *tables,
                    CAVEAT,
                ],
            ),
            _diagnosis(config, found),
            _delta(out),
            _training(out, config),
            *_flights(out),
            _run(out, config, seconds),
        ],
    )
    write_report(path, report)


def _diagnosis(config: HiddenConfig, found: Mapping[str, Any]) -> Section:
    gap = found["gap"]
    rows = []
    for effect in found["effects"]:
        for name, entry in effect["parameters"].items():
            value, interval = to_json(entry["value"]), to_json(entry["ci95"])
            cells = (effect["name"], ", ".join(effect["alternatives"]), name, value, interval)
            rows.append([Cell(text) for text in (*cells, entry["unit"])])
    headers = ["effect", "or", "parameter", "value", "95 % interval", "unit"]
    hidden = hidden_effects(load_vehicle(config.vehicle), load_vehicle(config.world))
    return Section(
        "What the diagnosis found in the flights",
        [
            f"Verdict: {found['verdict']}. Held-out gap {gap['before']:.2f} before, "
            f"{gap['after']:.2f} after; 1 is the noise floor.",
            Grid("", headers, rows),
            f"What the world's file holds and the simulation's does not: {hidden}.",
            Links([("diagnosis/report.html", "the diagnosis's own report")]),
        ],
    )


def hidden_effects(simulated: Vehicle, true: Vehicle) -> str:
    """Return the effects that `true` has and `simulated` has not, or has otherwise, in words."""
    parts = [
        f"{name} {value._asdict()}"
        for name, value in true.effects.items()
        if simulated.effects.get(name) != value
    ]
    parts += [f"no {name}" for name in simulated.effects if name not in true.effects]
    return "; ".join(parts) or "other nominal values"


def _delta(out: Path) -> Section:
    rows = []
    for variant, whose in ((CONTROL, "simulation's vehicle"), (NAMED, "corrected vehicle")):
        text = (out / f"delta-{variant}" / "delta.json").read_text(encoding="utf-8")
        fitted = json.loads(text)
        for key, name in (("without", whose), ("delta_action", f"{whose} with delta")):
            errors = fitted[key]
            numbers = (f"{errors['position_m']:.3f}", f"{errors['velocity_m_s']:.3f}")
            rows.append([Cell(text) for text in (name, *numbers)])
    headers = ["held-out flights, after 1 s", "position error [m]", "velocity error [m/s]"]
    words = (
        "Recorded actions are flown again through the differentiable quadrotor; the flights are "
        "as measured, so the noise of the start is in every row."
    )
    return Section("Delta Action Models on held-out flights", [words, Grid("", headers, rows)])


def _training(out: Path, config: HiddenConfig) -> Section:
    curves = {v: curve.read(out / f"tuned-{v}") for v in (CONTROL, DELTA, NAMED, BOTH)}
    words = (
        f"{config.tuning.optimizer.iterations} iterations each, from {config.policy}. Each curve "
        "is of the vehicle that it was trained in, so their levels are not comparable."
    )
    return Section("Fine-tuning", [words, Picture(tuning_chart(curves, LABELS), "Running means.")])


def _flights(out: Path) -> list[Section]:
    words = {
        BEFORE: "The first seed of every track at the easiest and the hardest level, from above, "
        "in the hidden world. Gates that were passed are green; a star is a finished trial, a "
        "cross where it ended.",
        NAMED: "The same trials.",
    }
    return [
        Section(
            f"Flights {TITLES[variant]}",
            [words[variant], Picture((out / "replays" / f"{variant}.png").read_bytes(), "")],
        )
        for variant in (BEFORE, NAMED)
    ]


def _run(out: Path, config: HiddenConfig, seconds: Mapping[str, float]) -> Section:
    links = [(path, words) for path, words in FILES if (out / path).is_file()]
    took = [[Cell(name), Cell(duration(value))] for name, value in seconds.items()]
    took.append([Cell("all"), Cell(duration(sum(seconds.values())))])
    return Section(
        "Files and configuration",
        [
            Links(links),
            Grid("Time", ["stage", "took"], took, strong_last=True),
            Details("Configuration", to_json(config, indent=2)),
        ],
    )

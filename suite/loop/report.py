"""What a loop's report shows."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from suite.common.console import duration
from suite.common.report import (
    Cell,
    Details,
    Grid,
    Links,
    Picture,
    Report,
    Section,
    write_report,
)
from suite.loop.charts import comparison_chart, delta_chart, training_chart
from suite.loop.compare import BEFORE, CAVEAT, WITH, WITHOUT, Line, grids, verdict
from suite.loop.config import LoopConfig
from suite.train import curve
from tracks.common.files import to_json
from tracks.common.provenance import git_commit
from tracks.common.version import VERSION

READING = (
    "All three policies fly the same trials in the MuJoCo quadrotor, without the Delta Action "
    "Model. Tuned without delta is the control: as many iterations on the same tracks, in the "
    "uncorrected point mass. Coloured differences are those whose interval does not hold zero."
)
FILES = (
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
)


def write_loop_report(
    path: Path, config: LoopConfig, lines: Sequence[Line], seconds: Mapping[str, float]
) -> None:
    """Write the report of the finished loop in the folder of `path`.

    Args:
        path: report.html.
        config: of the loop.
        lines: as `suite.loop.compare.compare` gives them.
        seconds: how long each stage took [s].
    """
    out = path.parent
    report = Report(
        title="Delta Action Model, with and without",
        lead=verdict(lines[-1]),
        facts={
            "trials": f"{lines[-1].trials} of each policy",
            "tracks": ", ".join(dict.fromkeys(line.track for line in lines[:-1])),
            "levels": config.difficulty,
            "vehicle": config.vehicle,
            "started from": config.policy or "training",
            "seed": str(config.seed),
            "version": f"{VERSION}, {(git_commit() or 'no commit')[:10]}",
        },
        sections=[
            Section(
                "On the same seeds",
                [
                    READING,
                    Picture(comparison_chart(lines), "Bars: 95 % intervals over trials."),
                    *grids(lines),
                    CAVEAT,
                ],
            ),
            _delta(out),
            _training(out, config),
            *_flights(out),
            _run(out, config, seconds),
        ],
    )
    write_report(path, report)


def _delta(out: Path) -> Section:
    fitted = json.loads((out / "delta" / "delta.json").read_text(encoding="utf-8"))
    base = fitted["point_mass"]["position_m"]
    names = (
        ("point_mass", "point mass as trained in"),
        ("fitted_point_mass", "point mass, lag, drag and delay fitted to the same flights"),
        ("delta_action", "point mass with Delta Action Model"),
    )
    rows = []
    for key, name in names:
        position, velocity = fitted[key]["position_m"], fitted[key]["velocity_m_s"]
        share = f"{100 * position / base:.0f} %"
        rows.append([Cell(t) for t in (name, f"{position:.3f}", f"{velocity:.3f}", share)])
    windows, held = fitted["windows"], len(fitted["held_out"])
    return Section(
        "Delta Action Model on held-out flights",
        [
            f"Recorded actions are flown again in the point mass for {fitted['horizon_s']:g} s. "
            f"{held} flights ({windows['held_out']} windows) took no part in any fit; "
            f"{windows['fit']} windows of the others did.",
            Grid("", ["", "position error [m]", "velocity error [m/s]", "of the first"], rows),
            Picture(
                delta_chart(fitted),
                f"Mean distance from the record after {fitted['horizon_s']:g} s.",
            ),
        ],
    )


def _training(out: Path, config: LoopConfig) -> Section:
    folders = {BEFORE: "train", WITHOUT: "tuned-without", WITH: "tuned-with"}
    curves = {variant: curve.read(out / folder) for variant, folder in folders.items()}
    first = f"{config.training.optimizer.iterations} iterations of training, then "
    if config.policy:
        first = f"From {config.policy}: "
    words = (
        f"{first}{config.tuning.optimizer.iterations} of fine-tuning, without and with the frozen "
        "Delta Action Model. The curves are of the point mass each was trained in, on random "
        "tracks, so the two fine-tunings' levels are not comparable: with the model it is another "
        "vehicle."
    )
    chart = training_chart(curves)
    return Section("Training", [words, Picture(chart, "Thin: each iteration. Thick: means.")])


def _flights(out: Path) -> list[Section]:
    words = {
        BEFORE: "The first seed of every track at the easiest and the hardest level, from above. "
        "Gates that were passed are green; a star is a finished trial, a cross where it ended.",
        WITH: "The same trials.",
    }
    titles = {BEFORE: "Flights before fine-tuning", WITH: "Flights, fine-tuned with delta"}
    sections = []
    for variant in (BEFORE, WITH):
        png = (out / "replays" / f"{variant}.png").read_bytes()
        sections.append(Section(titles[variant], [words[variant], Picture(png, "")]))
    return sections


def _run(out: Path, config: LoopConfig, seconds: Mapping[str, float]) -> Section:
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

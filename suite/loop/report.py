"""The report of a loop: its findings, its flights, its files and its configuration."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from suite.common.console import duration
from suite.common.report import Details, Links, Picture, Report, Section, write_report
from suite.loop.config import LoopConfig
from suite.loop.variants import Findings, Loop
from tracks.common.files import to_json
from tracks.common.grid import table
from tracks.common.provenance import VERSION, git_commit


def write_loop_report(
    out: Path, loop: Loop, config: LoopConfig, found: Findings, seconds: Mapping[str, float]
) -> None:
    """Write report.html of the finished loop in `out`; `seconds` are the times of the stages."""
    report = Report(
        title=loop.title,
        lead=found.verdict,
        facts={
            "trials": f"{config.trials * config.cells} of each policy",
            **found.facts,
            "started from": config.policy or "training",
            "seed": str(config.seed),
            "version": f"{VERSION}, {(git_commit() or 'no commit')[:10]}",
        },
        sections=[
            Section("On the same seeds", [loop.reading, found.chart, *found.tables, loop.caveat]),
            *found.sections,
            *_flights(out, loop),
            _run(out, loop, config, seconds),
        ],
    )
    write_report(out / "report.html", report)


def _flights(out: Path, loop: Loop) -> list[Section]:
    where = ", with the hidden vehicle" if loop.hidden else ""
    words = (
        "The first seed of every track at the easiest and the hardest level, from above"
        f"{where}. Gates that were passed are green; a star is a finished trial, a cross where it "
        "ended.",
        "The same trials.",
    )
    return [
        Section(
            one.heading,
            [text, Picture((out / "replays" / f"{one.variant}.png").read_bytes(), "")],
        )
        for one, text in zip(loop.shown, words, strict=True)
    ]


def _run(out: Path, loop: Loop, config: LoopConfig, seconds: Mapping[str, float]) -> Section:
    links = [(path, words) for path, words in loop.files if (out / path).is_file()]
    took = {**seconds, "all": sum(seconds.values())}
    times = [(name, duration(value)) for name, value in took.items()]
    return Section(
        "Files and configuration",
        [
            Links(links),
            table(["stage", "took"], times, "Time", strong_last=True),
            Details("Configuration", to_json(config, indent=2)),
        ],
    )


def errors_row(name: str, errors: Mapping[str, float], base_m: float | None = None) -> list[str]:
    """Return a row of a Delta Action Model's errors on held-out flights.

    Args:
        name: of the model.
        errors: `position_m` and `velocity_m_s`.
        base_m: position error to which a share is printed, if any.
    """
    texts = [name, f"{errors['position_m']:.3f}", f"{errors['velocity_m_s']:.3f}"]
    if base_m is not None:
        texts.append(f"{100 * errors['position_m'] / base_m:.0f} %")
    return texts

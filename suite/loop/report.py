"""Write the HTML report of a loop: its findings, pictures of flights, files and configuration.

The loop (`suite loop`) flies a policy, corrects the simulation from these flights, fine-tunes the
policy in it and compares the policies. The findings are the results of this comparison.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from suite.common.console import duration
from suite.common.report import Details, Links, Picture, Report, Section, write_report
from suite.judging.trials import parse_tracks
from suite.loop.config import LoopConfig
from suite.loop.tables import CAVEAT
from suite.loop.variants import Findings, Loop
from tracks.common.files import to_json
from tracks.common.grid import Grid, table
from tracks.common.provenance import VERSION, git_commit


def write_loop_report(
    out: Path,
    loop: Loop,
    config: LoopConfig,
    findings: Findings,
    results: Sequence[Grid | Picture],
    seconds: Mapping[str, float],
) -> None:
    """Write report.html of the finished loop in `out`.

    `results` are chart and tables of the policies, and `seconds` the times of the stages.
    """
    report = Report(
        title=loop.title,
        lead=findings.verdict,
        facts={
            "trials": f"{config.trials * config.cells} of each policy",
            "tracks": ", ".join(parse_tracks(config.track)),
            "levels": config.difficulty,
            **findings.facts,
            "started from": config.policy or "training",
            "seed": str(config.seed),
            "version": f"{VERSION}, {(git_commit() or 'no commit')[:10]}",
        },
        sections=[
            Section("On the same seeds", [loop.reading, *results, CAVEAT]),
            *findings.sections,
            *_flight_sections(out, loop),
            _files_section(out, loop, config, seconds),
        ],
    )
    write_report(out / "report.html", report)


def _flight_sections(out: Path, loop: Loop) -> list[Section]:
    """Return the sections with the pictures of flights: before the fine-tuning, and after it."""
    vehicle = ", with the hidden vehicle" if loop.hidden else ""
    texts = (
        "The first seed of every track at the easiest and the hardest level, from above"
        f"{vehicle}. Passed gates are green; a star is the end of a finished trial, a cross that "
        "of any other.",
        "The same trials.",
    )
    return [
        Section(
            shown.heading,
            [text, Picture((out / "replays" / f"{shown.variant}.png").read_bytes(), "")],
        )
        for shown, text in zip(loop.shown, texts, strict=True)
    ]


def _files_section(
    out: Path, loop: Loop, config: LoopConfig, seconds: Mapping[str, float]
) -> Section:
    """Return the section with links to existing files, times of the stages and the settings."""
    links = [(path, text) for path, text in loop.files if (out / path).is_file()]
    times_s = {**seconds, "all": sum(seconds.values())}
    rows = [(name, duration(value)) for name, value in times_s.items()]
    return Section(
        "Files and configuration",
        [
            Links(links),
            table(["stage", "took"], rows, "Time", strong_last=True),
            Details("Configuration", to_json(config, indent=2)),
        ],
    )

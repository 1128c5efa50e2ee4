"""Run a loop stage by stage, each in its own folder, and report the result (`suite loop`).

An interrupted stage continues where it stopped; a finished one is not repeated.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from eval.judging.results import read_trials
from suite.common.charts import dots, legend, percent_axis, png, titled
from suite.common.console import Console, command_line, duration
from suite.common.report import Details, Links, Part, Picture, Report, Section, html
from suite.common.stages import claim, run_stages, stage_commits
from suite.judging.flying import checkpoint_folder
from suite.judging.trials import parse_tracks
from suite.loop import delta_action, hidden_effect
from suite.loop.compare import CAVEAT, PolicyResult, cell_grid, overall_grid, policy_results
from suite.loop.config import LoopConfig, loop_by_content
from suite.loop.variants import COLOURS, Findings
from suite.loop.work import LoopRun, plan
from suite.train.run import warmup_warnings
from tracks.common.files import check_no_input, plain, to_json, write_json, write_text
from tracks.common.grid import markdown, rich_table, table
from tracks.common.provenance import VERSION, git_commit, stamp, stamp_text
from tracks.common.work import Workers

FILES = ("table.md", "report.html", "recording.rrd")
"""Files with the loop's results, which loop.json lists."""


def run_loop(
    config: LoopConfig, out: Path, console: Console, workers: Workers | None = None
) -> dict[str, Any]:
    """Run the loop, or its remaining stages, and print its results.

    An unfinished loop with the same settings in `out` continues, perhaps with another number of
    workers.

    Returns:
        The contents of loop.json, and `out`.

    Raises:
        ValueError: if `out` has a run of another configuration, is in the folder of the policy, or
            has a vehicle's file where the diagnosis writes.
        WorkFailed: if a training diverges, the flights cannot be used, or the diagnosis names
            nothing to correct.
    """
    loop = delta_action.LOOP
    if config.hidden_vehicle is not None:
        loop = hidden_effect.LOOP if config.delta else hidden_effect.WITHOUT_DELTA
    run = LoopRun(loop, config, Path(out), console, workers)
    _refuse_inputs_in(run.out, config)
    claim(run.out, loop_by_content(config), config.seed)
    trainings = {"the fine-tunings": config.tuning}
    if config.policy is None:
        trainings["the training"] = config.training
    for name, training in trainings.items():
        for warning in warmup_warnings(training):
            console.note(f"warning: {name}: {warning}")
    seconds = run_stages(run.out, plan(run), console, f"the loop, to {run.out}")
    return _report_results(run, seconds)


def _refuse_inputs_in(out: Path, config: LoopConfig) -> None:
    """Refuse an `out` in which the loop would copy the policy into itself or overwrite a vehicle.

    Raises:
        ValueError: naming the folder or the file.
    """
    if config.policy is not None:
        folder, place = checkpoint_folder(config.policy).resolve(), out.resolve()
        if folder in (place, *place.parents):
            raise ValueError(
                f"--out {out} is in the folder of the policy {config.policy}; give another --out"
            )
    vehicles = [config.vehicle, config.hidden_vehicle]
    check_no_input(out / "diagnosis" / "vehicle.toml", vehicles)


def _report_results(run: LoopRun, seconds: Mapping[str, float]) -> dict[str, Any]:
    """Write and print the tables and the report; return the contents of loop.json, and `out`."""
    # The results of all policies, and what follows from them.
    loop, config, out, console = run.loop, run.config, run.out, run.console
    folders = {variant.name: out / f"eval-{variant.name}" for variant in loop.variants}
    results = {name: read_trials(folder / "trials.parquet") for name, folder in folders.items()}
    policies, trials = policy_results(results, loop.references), config.trials * config.cells
    grids = [
        overall_grid(policies, loop.references, loop.labels, trials),
        cell_grid(policies, loop.labels),
    ]
    chart = Picture(success_chart(policies, loop.labels), "Bars: 95 % intervals over trials.")
    findings = loop.summarise(config, out, policies)
    caveat, commits = CAVEAT, stage_commits(out, seconds)
    if len(commits) > 1:
        listed = ", ".join(commits)
        caveat += f" The stages were done by {len(commits)} versions of the code: {listed}."
    # Write table.md, loop.json and report.html.
    header = stamp(1, config.seed)
    texts = [
        findings.verdict,
        *map(markdown, grids),
        caveat,
        *findings.errors,
        f"<!-- {stamp_text(header)} -->\n",
    ]
    write_text(out / "table.md", "\n\n".join(text.strip("\n") for text in texts) + "\n")
    answer = {
        **header,
        "verdict": findings.verdict,
        "standings": policies,
        **findings.numbers,
        "seeds": seeds(run),
        "stage_seconds": {name: round(value, 1) for name, value in seconds.items()},
        "stage_commits": commits,
        "config": config,
        "files": {name: name for name in FILES},
    }
    write_json(out / "loop.json", answer)
    results_parts = [chart, *grids, caveat]
    write_text(
        out / "report.html", html(_report(run, findings, results_parts, seconds), config.seed)
    )
    # Print the same tables, the verdict and where the files are.
    for grid in grids:
        console.show(rich_table(grid))
    console.say(f"{caveat}\n\n{findings.verdict}\n")
    console.say(f"table:     {out / 'table.md'}")
    console.say(f"report:    {out / 'report.html'}")
    if loop.hidden:
        console.say(f"diagnosis: {out / 'diagnosis' / 'report.html'}")
    recording = out / "recording.rrd"
    console.say(f"recording: {recording} (open it with: {command_line('rerun', recording)})")
    return {**plain(answer), "out": str(out)}


def seeds(run: LoopRun) -> dict[str, Any]:
    """Return the first and the last seed of the trials and of the recorded flights."""
    config = run.config
    trained = "fine-tuning" if run.loop.hidden else "training"
    return {
        trained: "the random family, which is never judged",
        "judged": [config.seed, config.seed + config.trials - 1],
        "recorded": [config.recorded_from, config.recorded_from + config.flights - 1],
    }


def _report(
    run: LoopRun,
    findings: Findings,
    results: Sequence[Part],
    seconds: Mapping[str, float],
) -> Report:
    """Return the report: chart and tables of the policies, findings, pictures of flights, files.

    `results` are the chart, the tables and a note on them; `seconds` are the times of the stages
    [s].
    """
    loop, config, out = run.loop, run.config, run.out
    vehicle = ", with the hidden vehicle" if loop.hidden else ""
    texts = (
        "The first seed of every track at the easiest and the hardest level, from above"
        f"{vehicle}. Passed gates are green; a star is the end of a finished trial, a cross that "
        "of any other.",
        "The same trials.",
    )
    flights = [
        Section(s.heading, [text, Picture((out / "replays" / f"{s.variant}.png").read_bytes(), "")])
        for s, text in zip(loop.shown, texts, strict=True)
    ]
    links = [(path, text) for path, text in loop.files if (out / path).is_file()]
    times_s = {**seconds, "all": sum(seconds.values())}
    rows = [(name, duration(value)) for name, value in times_s.items()]
    files = [
        Links(links),
        table(["stage", "took"], rows, "Time of the last call", strong_last=True),
        Details("Configuration", to_json(config, indent=2)),
    ]
    return Report(
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
            Section("On the same seeds", [loop.reading, *results]),
            *findings.sections,
            *flights,
            Section("Files and configuration", files),
        ],
    )


def success_chart(results: Sequence[PolicyResult], labels: Mapping[str, str]) -> bytes:
    """Return the chart of success rates of any policies, by cell and over all trials.

    `labels` are by the policies' names.
    """
    figure = Figure(figsize=(10.4, 4.2), layout="constrained")
    axes = figure.subplots()
    cells = [cell.replace(" ", "\nlevel ") for cell in (*results[0].by_cell, "all")]
    for number, (result, colour) in enumerate(zip(results, COLOURS, strict=False)):
        # Dots of neighbouring policies are 0.13 widths of a cell apart.
        x = np.arange(len(cells)) + 0.13 * (number - 0.5 * (len(results) - 1))
        intervals = [*result.by_cell.values(), result.success]
        dots(axes, x, intervals, 100, color=colour, label=labels[result.name], ms=5, lw=1.6)
    titled(axes, "Success [%]")
    axes.set_xticks(range(len(cells)), cells, fontsize=8)
    # A line separates the last cell, that of all trials.
    axes.axvline(len(cells) - 1.5, color="#b8bec8", lw=0.8)
    lowest = min(rate.low for each in results for rate in (*each.by_cell.values(), each.success))
    percent_axis(axes, 100 * lowest)
    legend(figure, axes)
    return png(figure)

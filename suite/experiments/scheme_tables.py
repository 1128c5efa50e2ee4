"""What the page about training schemes shows: tables and sentences."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from suite.common.console import duration
from suite.common.report import Cell, Grid, Picture, Report, Section, ranged
from suite.experiments.scheme_charts import scheme_chart
from suite.experiments.scheme_curves import FIGURE, METRICS, WANTED, Row, value_at
from suite.experiments.seed_intervals import Spread

if TYPE_CHECKING:
    from suite.experiments.schemes import Config, Learnt, Scheme


def verdict(rows: Sequence[Row]) -> str:
    """Return what came out in sentences, and whether it is what the paper says."""
    measured = {row.scheme: row for row in rows if row.curves}
    said = [f"Every training of {row.words} diverged." for row in rows if not row.curves]
    for row in measured.values():
        cross, rate = row.curves["success_cross"][-1], row.curves["success_rate"][-1]
        said.append(
            f"{row.words[0].upper()}{row.words[1:]}: {row.curves['gates'][-1].mean:.2f} gates, "
            f"success cross {100 * cross.mean:.0f} %, success rate {100 * rate.mean:.0f} % after "
            f"{row.steps[-1]:,} environment steps ({duration(row.time[-1])} of training)."
        )
    if {"ours", "ppo"} <= set(measured):
        ours, ppo = measured["ours"], measured["ppo"]
        steps = _ahead(ours, ppo, lambda row, name: row.curves[name][-1])
        limit = min(ours.time[-1], ppo.time[-1])
        clock = _ahead(ours, ppo, lambda row, name: value_at(row, name, limit))
        said.append(
            f"The paper has ours ahead of PPO in {_listed(FIGURE)}; here it is ahead at the end "
            f"in {steps}, and after {duration(limit)} of training each in {clock}."
        )
    if {"ours", "projection"} <= set(measured):
        ours, bare = (measured[name].curves["gates"][-1] for name in ("ours", "projection"))
        said.append(
            "The paper's scheme without the field fails to learn to cross gates; here it passes "
            f"{bare.mean:.2f} ({bare.least:.2f} to {bare.most:.2f} over seeds), with the field "
            f"{ours.mean:.2f} ({ours.least:.2f} to {ours.most:.2f})."
        )
    return " ".join(said)


def _ahead(ours: Row, other: Row, pick: Callable[[Row, str], Spread]) -> str:
    """Return in which of the figure's numbers ours has the higher mean, and where seeds part."""
    pairs = {name: (pick(ours, name), pick(other, name)) for name in FIGURE}
    ahead = [name for name, (a, b) in pairs.items() if a.mean > b.mean]
    apart = [name for name, (a, b) in pairs.items() if a.least > b.most]
    return f"{_listed(ahead)} (with every seed above every one of PPO's: {_listed(apart)})"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(METRICS[name][0].split(" [")[0] for name in names) or "none of them"


def scheme_report(
    config: Config, chosen: Sequence[Scheme], rows: Sequence[Row], results: Sequence[Learnt]
) -> Report:
    """Return the document.

    Args:
        config: what was asked.
        chosen: the schemes.
        rows: of `summaries`.
        results: of every run.
    """
    episode, measured = chosen[0].recipe.episode, [row for row in rows if row.curves]
    pictures, tables = [], []
    if measured:
        pictures = [Picture(scheme_chart(measured), CAPTION)]
        limit = min(row.time[-1] for row in measured)
        end = _numbers("At the end of each budget", measured, lambda r, n: r.curves[n][-1])
        same = f"After {duration(limit)} of training, the shortest of the budgets"
        clock = _numbers(same, measured, lambda r, n: value_at(r, n, limit))
        tables = [end, clock, _reached(measured)]
    return Report(
        title="Training schemes compared: PPO, ours, ours without the field",
        lead=verdict(rows),
        facts={
            "recipe": " ".join(
                [config.preset, *config.set, f"episode.gates={episode.gates}",
                 f"lambda_p={config.progress:g}"]
            ),
            "an iteration": f"{episode.batch} worlds x {episode.steps} steps",
            "training seeds": " ".join(map(str, config.training_seeds)),
            "trained at commit": ", ".join(sorted({run.commit for run in results})),
            "unseen worlds": f"{config.trials}, seed {config.seed}, {config.seconds:g} s each",
            "trainings at once": f"{config.jobs}, each on its own share of the cores",
        },
        sections=[
            Section("Learning curves", [*pictures, *tables]),
            Section("Every training", [_every(results)]),
            Section("What was measured", MEANING),
        ],
    )  # fmt: skip


CAPTION = (
    "Over environment steps (above) and over seconds of training (below): mean over training "
    "seeds, with a band from the least to the most."
)
MEANING = (
    "Reward: the paper's, summed over a trial until its end. Success rate: no collision, whatever "
    "gates were passed. Success cross: all gates passed without a collision before. v_max: the "
    "median over trials of each one's largest speed. Trials end at a collision, at the last gate "
    "or at their time, and fly the training's dynamics on worlds that no training has seen, the "
    "same for all; a collision is what the trainer takes for one, by its own code.",
    "Policy, dynamics, worlds and environment steps of an iteration are the same for all schemes. "
    "PPO learns from the reward that is measured; the other two from their losses, with the "
    "recipe's weights but for lambda_p. Without the field, L_proj stands in with the paper's "
    "lambda_proj and beta_3.",
    "Seconds are those of iterations alone: measurements are left out, and iterations that compile "
    "count as long as the median of the others; what they took longer stands in the table. Each "
    "training is held to its share of the cores, the same for all; what else the machine did "
    "meanwhile is in the seconds.",
    "A time of reaching so many gates is that of the first measurement which has them: the median "
    "over the seeds that do, and of how many.",
)


def _numbers(title: str, rows: Sequence[Row], pick: Callable[[Row, str], Spread]) -> Grid:
    headers = ["scheme", *(title for title, _, _ in METRICS.values()), "diverged"]
    cells = []
    for row in rows:
        line = [row.words]
        for name, (_, scale, digits) in METRICS.items():
            mean, least, most = (scale * value for value in pick(row, name))
            line.append(ranged(mean, least, most, digits))
        cells.append([Cell(text) for text in [*line, f"{row.diverged} of {row.seeds}"]])
    return Grid(f"{title}: mean over seeds [least, most]", headers, cells)


def _reached(rows: Sequence[Row]) -> Grid:
    headers = ["scheme", *(f"{gates} gates" if gates > 1 else "1 gate" for gates in WANTED),
               "whole budget", "compilation"]  # fmt: skip
    cells = []
    for row in rows:
        line = [row.words]
        for gates in WANTED:
            found = np.array(row.reached[gates]).reshape(-1, 2)
            steps, time = np.median(found, axis=0) if len(found) else (0, 0)
            times = f"{steps:,.0f} steps, {duration(time)} ({len(found)} of {row.seeds})"
            line.append(times if len(found) else "not reached")
        line += [f"{row.steps[-1]:,} steps, {duration(row.time[-1])}", duration(row.compile_s)]
        cells.append([Cell(text) for text in line])
    return Grid("Steps and time of training to so many gates a trial", headers, cells)


def _every(results: Sequence[Learnt]) -> Grid:
    headers = ["scheme", "training seed", *(title for title, _, _ in METRICS.values()),
               "trained for"]  # fmt: skip
    cells = []
    for run in results:
        line = [run.scheme, str(run.seed)]
        if run.diverged or not run.points:
            line += ["diverged"] + ["-"] * len(METRICS)
        else:
            last = run.points[-1]
            line += [f"{s * last[n]:.{d + 1}f}" for n, (_, s, d) in METRICS.items()]
            line += [duration(last["time"])]
        cells.append([Cell(text) for text in line])
    return Grid("", headers, cells)

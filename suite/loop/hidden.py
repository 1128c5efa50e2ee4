"""The loop in a world with an effect that the simulation lacks, stage by stage.

A loop's folder holds given/, eval-nominal/, eval-before/, flights/, measured/, diagnosis/,
delta-control/, delta-named/, then tuned-X/ and eval-X/ for each fine-tuned policy, and replays/;
then table.md, loop.json, report.html and recording.rrd. Every stage goes on where it was cut off.

The hidden world's file is read by the judge alone. The simulation learns of it through the
measured flights only.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from eval.judging.results import read_trials
from eval.quadrotor.vehicle_file import load_vehicle
from policies.formats.delta_file import load_delta
from policies.formats.policy_file import load_policy_checkpoint
from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.common.estimate import Estimate, announce
from suite.common.report import markdown, rich_table
from suite.common.stages import Stages, claim
from suite.delta.run import PLANT_STEPS_S, fit_quadrotor_delta
from suite.diagnose.run import diagnose_files
from suite.judging.collect import Collection
from suite.judging.evaluate import Judgement
from suite.loop.hidden_config import HiddenConfig
from suite.loop.hidden_report import (
    BEFORE,
    BOTH,
    CAVEAT,
    CONTROL,
    DELTA,
    LABELS,
    NAMED,
    NOMINAL,
    REFERENCES,
    TITLES,
    VARIANTS,
    named_effects,
    verdict,
    write_hidden_report,
)
from suite.loop.measured import enough, measure
from suite.loop.replays import write_replays
from suite.loop.variants import Standing, cell_grid, overall_grid, standings
from suite.loop.work import flying, judge, record, take_policy, what_is_left
from suite.train import run as training
from suite.train.config import QuadrotorConfig, TrainConfig
from tracks.common.files import plain, write_json, write_text
from tracks.common.provenance import stamp

STAGES = 17
"""How many stages a loop has."""
DIAGNOSED_S = 80.0
"""The diagnosis gets about this much flight, of all tracks and levels in turn [s]."""
DRIVE = "commands"
"""The judge's rate loop is the vehicle file's, so the diagnosis need not ask whose it is; driven by
rotor speeds a wrong torque runs away within a second."""
DIAGNOSIS_S = 90.0
"""How long it takes, for the estimate [s]."""
QUADROTOR_COST = 3.0
"""A gradient step through the quadrotor over one through the point mass, for the estimate."""
TUNED = (CONTROL, DELTA, NAMED, BOTH)
"""The fine-tuned policies."""
WHOSE = {CONTROL: "the simulation's quadrotor", NAMED: "the corrected quadrotor"}
"""What is corrected by the Delta Action Models."""
AS = {
    CONTROL: "as the control",
    DELTA: "with the Delta Action Model",
    NAMED: "with the named effect",
    BOTH: "with both",
}
"""How, in words."""


def run_hidden_loop(config: HiddenConfig, out: Path, console: Console) -> dict[str, Any]:
    """Run the loop, or what is left of it, and print what it showed.

    Args:
        config: the whole loop.
        out: its folder; one with a loop of the same configuration is gone on with.
        console: where progress and results go.

    Returns:
        What loop.json holds, and `out`.

    Raises:
        ValueError: where `out` holds a run of another configuration.
        WorkFailed: where a fine-tuning diverges, the flights cannot be used, or the diagnosis
            names nothing to correct.
    """
    out = Path(out)
    claim(out, config, config.seed)
    stages = Stages(out, console, STAGES)
    left = estimate(config, stages)
    if left.seconds:
        announce(console, f"the loop, to {out}", left)
    given = take_policy(stages, config.policy)
    policies = {NOMINAL: given, BEFORE: given}
    judged = {name: _judge(config, stages, name, given) for name in (NOMINAL, BEFORE)}
    record(stages, _collection(config, given))
    found = _diagnose(config, stages)
    for name in WHOSE:
        _fit(config, stages, name)
    for name in TUNED:
        policies[name] = _tune(config, stages, name, given)
    for name in TUNED:
        judged[name] = _judge(config, stages, name, policies[name])
    words = "flying a few trials again for the recording and the pictures"
    shown = {name: (TITLES[name], policies[name]) for name in (BEFORE, NAMED)}
    judgement = _judgement(config, BEFORE, given)
    stages.do("replays", words, lambda folder: write_replays(judgement, shown, folder))
    results = {name: read_trials(judged[name] / "trials.parquet") for name in VARIANTS}
    return _conclude(config, stages, found, standings(results, REFERENCES))


def estimate(config: HiddenConfig, stages: Stages) -> Estimate:
    """Return about how long the stages that are left take, and the largest memory of one."""
    point = training.estimate(replace(config.tuning, quadrotor=None))
    tune = Estimate(QUADROTOR_COST * point.seconds, point.memory_bytes)
    steps = 200 * config.fit.horizon_s * config.fit.batch * config.fit.iterations
    fitting = Estimate(40 + steps / PLANT_STEPS_S, 1.5e9)
    trials, flights = config.trials * config.cells, config.flights * config.cells
    needs = {
        "given": Estimate(0, 0),
        "flights": flying(flights),
        "measured": Estimate(1 + 0.05 * flights, 0),
        "diagnosis": Estimate(DIAGNOSIS_S, 1.5e9),
        **{f"delta-{name}": fitting for name in WHOSE},
        **{f"tuned-{name}": tune for name in TUNED},
        **{f"eval-{name}": flying(trials) for name in VARIANTS},
        "replays": flying(12),
    }
    return what_is_left(stages, needs)


def _judgement(config: HiddenConfig, variant: str, policy: Path) -> Judgement:
    return Judgement(
        policies=(str(policy),),
        track=config.track,
        difficulty=config.difficulty,
        trials=config.trials,
        seed=config.seed,
        vehicle=config.vehicle if variant == NOMINAL else config.world,
    )


def _judge(config: HiddenConfig, stages: Stages, variant: str, policy: Path) -> Path:
    where = "the simulation's vehicle" if variant == NOMINAL else "the hidden world"
    words = f"judging the policy in {where}"
    if variant in TUNED:
        words = f"judging the one fine-tuned {AS[variant]}, on the same seeds"
    return judge(stages, f"eval-{variant}", words, _judgement(config, variant, policy))


def _collection(config: HiddenConfig, policy: Path) -> Collection:
    return Collection(
        policy=str(policy),
        track=config.track,
        difficulty=config.difficulty,
        trials=config.flights,
        vehicle=config.world,
        seed=config.recorded_from,
    )


def _diagnose(config: HiddenConfig, stages: Stages) -> dict[str, Any]:
    """Return what diagnosis.json holds, from flights in the hidden world."""
    flights, measured = stages.out / "flights", stages.out / "measured"

    def cut(folder: Path) -> None:
        try:
            files = measure(flights, folder, config.seed)
        except ValueError as error:
            raise WorkFailed(f"{error}; record more flights (--flights)") from error
        chosen = [file.name for file in enough(files, DIAGNOSED_S)]
        write_json(folder / "diagnosed.json", {"files": chosen})

    stages.do("measured", "cutting the flights before contact, with a log's noise", cut)

    def work(folder: Path) -> None:
        listed = json.loads((measured / "diagnosed.json").read_text(encoding="utf-8"))
        paths = [measured / name for name in listed["files"]]
        try:
            diagnose_files(
                paths, config.vehicle, folder, stages.console, drive=DRIVE, seed=config.seed
            )
        except ValueError as error:
            raise WorkFailed(f"the flights in {measured} cannot be diagnosed: {error}") from error

    folder = stages.do("diagnosis", "asking the diagnosis what the vehicle file lacks", work)
    found = json.loads((folder / "diagnosis.json").read_text(encoding="utf-8"))
    stages.console.note(f"    {found['verdict']}: {named_effects(found) or 'nothing named'}")
    if not found["effects"]:
        raise WorkFailed(
            f"the diagnosis says {found['verdict']} and names nothing to correct, see "
            f"{folder / 'report.html'}; record more flights (--flights) with another --out"
        )
    return found


def _quadrotor(config: HiddenConfig, stages: Stages, variant: str) -> QuadrotorConfig:
    quad = config.tuning.quadrotor
    assert quad is not None
    if variant in (NAMED, BOTH):
        vehicle = load_vehicle(stages.out / "diagnosis" / "vehicle.toml")
        return replace(quad, vehicle=vehicle)
    return quad


def _fit(config: HiddenConfig, stages: Stages, variant: str) -> None:
    quad = _quadrotor(config, stages, variant)

    def work(folder: Path) -> None:
        logs = sorted((stages.out / "measured").glob("*.parquet"))
        try:
            fit_quadrotor_delta(config.fit, quad, logs, folder, stages.console)
        except ValueError as error:
            raise WorkFailed(
                f"the Delta Action Model cannot be fitted to the flights in "
                f"{stages.out / 'measured'}: {error}; record more (--flights), with another --out"
            ) from error

    words = f"fitting the Delta Action Model of {WHOSE[variant]}"
    folder = stages.do(f"delta-{variant}", words, work)
    for line in (folder / "table.md").read_text(encoding="utf-8").splitlines():
        stages.console.note(f"    {line}")


def _tune(config: HiddenConfig, stages: Stages, variant: str, policy: Path) -> Path:
    run: TrainConfig = replace(config.tuning, quadrotor=_quadrotor(config, stages, variant))

    def work(folder: Path) -> None:
        start = jax.tree.map(jnp.asarray, load_policy_checkpoint(policy).params)
        delta = None
        if variant in (DELTA, BOTH):
            of = CONTROL if variant == DELTA else NAMED
            fitted = load_delta(stages.out / f"delta-{of}" / "delta").params
            delta = jax.tree.map(jnp.asarray, fitted)
        training.train(run, folder, stages.console, start, delta)

    how = {
        CONTROL: "through the simulation's vehicle, as the control",
        DELTA: "through the simulation's vehicle and the frozen Delta Action Model",
        NAMED: "through the corrected vehicle",
        BOTH: "through the corrected vehicle and the frozen Delta Action Model of what it lacks",
    }[variant]
    return stages.do(f"tuned-{variant}", f"fine-tuning {how}", work) / "policy"


def _conclude(
    config: HiddenConfig, stages: Stages, found: dict[str, Any], stand: list[Standing]
) -> dict[str, Any]:
    """Write and print the tables and the report."""
    out, console = stages.out, stages.console
    trials = config.trials * config.cells
    tables = [overall_grid(stand, REFERENCES, LABELS, trials), cell_grid(stand, LABELS)]
    words = verdict(stand, found, trials)
    errors = [
        f"Delta Action Model of {whose}\n\n"
        + (out / f"delta-{name}" / "table.md").read_text(encoding="utf-8")
        for name, whose in WHOSE.items()
    ]
    header = stamp(1, config.seed)
    marks = "; ".join(f"{key}: {value}" for key, value in header.items())
    parts = [words, *map(markdown, tables), CAVEAT, *errors, f"<!-- {marks} -->\n"]
    write_text(out / "table.md", "\n\n".join(part.strip("\n") for part in parts) + "\n")
    answer = {
        **header,
        "verdict": words,
        "standings": stand,
        "diagnosis": {key: found[key] for key in ("verdict", "effects", "gap", "unexplained")},
        "seeds": {
            "fine-tuning": "the random family, which is never judged",
            "judged": [config.seed, config.seed + config.trials - 1],
            "recorded": [config.recorded_from, config.recorded_from + config.flights - 1],
        },
        "stage_seconds": {name: round(took, 1) for name, took in stages.seconds.items()},
        "config": config,
        "files": {name: name for name in ("table.md", "report.html", "recording.rrd")},
    }
    write_json(out / "loop.json", answer)
    write_hidden_report(out / "report.html", config, stand, tables, found, stages.seconds)
    for table in tables:
        console.show(rich_table(table))
    console.say(f"{CAVEAT}\n\n{words}\n")
    console.say(f"table:     {out / 'table.md'}")
    console.say(f"report:    {out / 'report.html'}")
    console.say(f"diagnosis: {out / 'diagnosis' / 'report.html'}")
    recording = out / "recording.rrd"
    console.say(f"recording: {recording} (open it with: rerun {recording})")
    return {**plain(answer), "out": str(out)}

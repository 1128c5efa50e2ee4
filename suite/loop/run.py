"""The loop, stage by stage, each in a folder of its own.

A loop's folder holds train/ (or given/), eval-before/, flights/, delta/, tuned-without/,
tuned-with/, eval-without/, eval-with/ and replays/; then table.md, loop.json, report.html and
recording.rrd. Every stage goes on where it was cut off; a finished one is not done again.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from eval.judging.results import read_trials
from policies.formats.delta_file import load_delta
from policies.formats.policy_file import load_policy_checkpoint
from policies.networks.network import fitted
from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.common.estimate import Estimate, announce
from suite.common.report import markdown, rich_table
from suite.common.stages import Stages, claim
from suite.delta.run import fit_delta
from suite.judging.collect import Collection
from suite.judging.evaluate import Judgement
from suite.loop.compare import (
    BEFORE,
    CAVEAT,
    VARIANTS,
    WITH,
    WITHOUT,
    Line,
    compare,
    grids,
    verdict,
)
from suite.loop.config import LoopConfig
from suite.loop.replays import write_replays
from suite.loop.report import write_loop_report
from suite.loop.work import flying, judge, record, take_policy, what_is_left
from suite.train import run as training
from tracks.common.files import plain, write_json, write_text
from tracks.common.provenance import stamp

STAGES = 9
"""How many stages a loop has."""
RECORDING = "recording.rrd"


def run_loop(config: LoopConfig, out: Path, console: Console) -> dict[str, Any]:
    """Run the loop, or what is left of it, and print what it showed.

    Args:
        config: the whole loop.
        out: its folder; one with a loop of the same configuration is gone on with.
        console: where progress and results go.

    Returns:
        What loop.json holds, and `out`.

    Raises:
        ValueError: where `out` holds a run of another configuration.
        WorkFailed: where the training diverges, or its policy cannot be recorded.
    """
    out = Path(out)
    claim(out, config, config.seed)
    stages = Stages(out, console, STAGES)
    left = estimate(config, stages)
    if left.seconds:
        announce(console, f"the loop, to {out}", left)
    policies = {BEFORE: _first_policy(config, stages)}
    judged = {BEFORE: _judge(config, stages, BEFORE, policies[BEFORE])}
    _record(config, stages, policies[BEFORE])
    _fit(config, stages)
    for variant in (WITHOUT, WITH):
        policies[variant] = _tune(config, stages, variant, policies[BEFORE])
    for variant in (WITHOUT, WITH):
        judged[variant] = _judge(config, stages, variant, policies[variant])
    words = "flying a few trials again for the recording and the pictures"
    shown = {BEFORE: ("before", policies[BEFORE]), WITH: ("tuned with delta", policies[WITH])}
    judgement = _judgement(config, policies[BEFORE])
    stages.do("replays", words, lambda folder: write_replays(judgement, shown, folder))
    lines = compare({name: read_trials(judged[name] / "trials.parquet") for name in VARIANTS})
    return _conclude(config, stages, lines)


def estimate(config: LoopConfig, stages: Stages) -> Estimate:
    """Return about how long the stages that are left take, and the largest memory of one."""
    train, tune = training.estimate(config.training), training.estimate(config.tuning)

    judging, recording = (flying(n * config.cells) for n in (config.trials, config.flights))
    steps = config.fit.horizon_s * config.training.spec.rate_hz
    fitting = Estimate(20 + config.fit.iterations * config.fit.batch * steps / 1.5e5, 8e8)
    needs = {
        **({"given": Estimate(0, 0)} if config.policy else {"train": train}),
        "flights": recording,
        "delta": fitting,
        **{f"eval-{name}": judging for name in VARIANTS},
        **{f"tuned-{name}": tune for name in (WITHOUT, WITH)},
        "replays": flying(12),
    }
    return what_is_left(stages, needs)


def _first_policy(config: LoopConfig, stages: Stages) -> Path:
    given = config.policy
    if given is None:

        def train(folder: Path) -> None:
            training.train(config.training, folder, stages.console)

        return stages.do("train", "training in the point mass", train) / "policy"

    return take_policy(stages, given)


def _judge(config: LoopConfig, stages: Stages, variant: str, policy: Path) -> Path:
    words = "judging the policy in MuJoCo"
    if variant != BEFORE:
        words = f"judging the one fine-tuned {variant} the Delta Action Model, on the same seeds"
    return judge(stages, f"eval-{variant}", words, _judgement(config, policy))


def _judgement(config: LoopConfig, policy: Path) -> Judgement:
    return Judgement(
        policies=(str(policy),),
        track=config.track,
        difficulty=config.difficulty,
        trials=config.trials,
        seed=config.seed,
        vehicle=config.vehicle,
    )


def _record(config: LoopConfig, stages: Stages, policy: Path) -> None:
    collection = Collection(
        policy=str(policy),
        track=config.track,
        difficulty=config.difficulty,
        trials=config.flights,
        vehicle=config.vehicle,
        seed=config.recorded_from,
    )
    record(stages, collection)


def _fit(config: LoopConfig, stages: Stages) -> None:
    def work(folder: Path) -> None:
        flights = stages.out / "flights"
        try:
            fit_delta(config.fit, config.training.physics, [flights], folder, stages.console)
        except ValueError as error:
            raise WorkFailed(
                f"the Delta Action Model cannot be fitted to the flights in {flights}: {error}. "
                "Where the policy crashes within a second or two, train it for longer "
                "(--iterations), or record more flights (--flights), with another --out"
            ) from error

    folder = stages.do("delta", "fitting the Delta Action Model to the flights", work)
    table = (folder / "table.md").read_text(encoding="utf-8")
    for line in table.splitlines():
        stages.console.note(f"    {line}")


def _tune(config: LoopConfig, stages: Stages, variant: str, policy: Path) -> Path:
    def work(folder: Path) -> None:
        stored = load_policy_checkpoint(policy)
        start = jax.tree.map(jnp.asarray, stored.params)
        start = fitted(start, stored.spec, config.tuning.spec)
        delta = None
        if variant == WITH:
            model = load_delta(stages.out / "delta" / "delta").params
            delta = jax.tree.map(jnp.asarray, model)
        training.train(config.tuning, folder, stages.console, start, delta)

    how = "under the frozen Delta Action Model" if variant == WITH else "without it, as the control"
    return stages.do(f"tuned-{variant}", f"fine-tuning {how}", work) / "policy"


def _conclude(config: LoopConfig, stages: Stages, lines: list[Line]) -> dict[str, Any]:
    """Write and print the tables and the report."""
    out, console = stages.out, stages.console
    tables = grids(lines)
    errors = (out / "delta" / "table.md").read_text(encoding="utf-8")
    fitted = json.loads((out / "delta" / "delta.json").read_text(encoding="utf-8"))
    header = stamp(1, config.seed)
    marks = "; ".join(f"{key}: {value}" for key, value in header.items())
    parts = [verdict(lines[-1]), *map(markdown, tables), CAVEAT, errors, f"<!-- {marks} -->\n"]
    write_text(out / "table.md", "\n\n".join(part.strip("\n") for part in parts) + "\n")
    answer = {
        **header,
        "verdict": verdict(lines[-1]),
        "comparison": lines,
        "delta": {key: value for key, value in fitted.items() if key != "curve"},
        "seeds": seeds(config),
        "stage_seconds": {name: round(took, 1) for name, took in stages.seconds.items()},
        "config": config,
        "files": {name: name for name in ("table.md", "report.html", RECORDING)},
    }
    write_json(out / "loop.json", answer)
    write_loop_report(out / "report.html", config, lines, stages.seconds)
    for table in tables:
        console.show(rich_table(table))
    console.say(f"{CAVEAT}\n\n{errors}\n{verdict(lines[-1])}\n")
    console.say(f"table:     {out / 'table.md'}")
    console.say(f"report:    {out / 'report.html'}")
    console.say(f"recording: {out / RECORDING} (open it with: rerun {out / RECORDING})")
    return {**plain(answer), "out": str(out)}


def seeds(config: LoopConfig) -> dict[str, Any]:
    """Return which seeds the trials and the recorded flights have: first and last."""
    return {
        "training": "the random family, which is never judged",
        "judged": [config.seed, config.seed + config.trials - 1],
        "recorded": [config.recorded_from, config.recorded_from + config.flights - 1],
    }

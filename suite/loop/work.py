"""The stages of a loop, and their list for a kind of loop."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.judging.results import read_trials
from eval.quadrotor.vehicle_file import load_vehicle
from policies.formats.policy_file import load_delta
from suite.common.console import Console, Quiet
from suite.common.errors import WorkFailed
from suite.common.running.apart import Job
from suite.common.stages import Estimate, Stage, is_done
from suite.common.work import all_done
from suite.delta.run import fit_delta, fitting_estimate
from suite.judging.collect import collect
from suite.judging.evaluate import evaluate
from suite.judging.flying import checkpoint_folder, flying_needs, workers_for
from suite.judging.replay import first_trials, fly_again
from suite.judging.requests import Collection, Evaluation, parse_levels
from suite.loop.compare import BEFORE
from suite.loop.config import OWN, DeltaLoopConfig, LoopConfig
from suite.loop.measured import enough, measure
from suite.loop.variants import DeltaModel, Loop, Variant
from suite.train import run as training
from suite.train.config import TrainConfig
from tracks.common.files import replacing_folder, write_json
from tracks.common.work import Workers

DIAGNOSED_S = 80.0
"""Approximate length of the diagnosed flights, in turn from all tracks and levels [s]."""
INPUT_SOURCE = "commands"
"""Input of the diagnosed model: the judge's rate loop is that of the vehicle file. With rotor
speeds as input, a wrong torque diverges within a second."""
DIAGNOSIS = Estimate(90.0, 1.5e9)
"""Time and memory of a diagnosis."""
PHYSICS_HZ = 200.0
"""Physics steps of the quadrotor in a fit of the Delta Action Model, for the estimate [Hz]."""


@dataclass(frozen=True)
class LoopRun:
    """A loop in its folder."""

    loop: Loop
    """The kind of loop."""
    config: LoopConfig
    """Its settings."""
    out: Path
    """The folder."""
    console: Console
    """Shows progress."""
    workers: Workers | None = None
    """Of flights and fine-tunings; None flies in as many processes as shorten the work and
    fine-tunes one policy after the other."""

    @property
    def logs(self) -> Path:
        """The folder of the flights for fits and diagnosis."""
        return self.out / ("measured" if self.loop.hidden else "flights")

    def policy(self, variant: Variant) -> Path:
        """Return the folder of a variant's policy."""
        first = "train" if self.config.policy is None else "given"
        return self.out / (f"tuned-{variant.name}" if variant.tuned else first) / "policy"

    def tuning(self, diagnosed: bool) -> TrainConfig:
        """Return the fine-tuning, through the vehicle that the diagnosis corrected if asked."""
        tuning = self.config.tuning
        if not diagnosed or tuning.quadrotor is None:
            return tuning
        vehicle = load_vehicle(self.out / "diagnosis" / "vehicle.toml")
        return replace(tuning, quadrotor=replace(tuning.quadrotor, vehicle=vehicle))


def plan(run: LoopRun) -> list[Stage]:
    """Return the stages of a loop in order."""
    first = [variant for variant in run.loop.variants if variant.tuned is None]
    later = [variant for variant in run.loop.variants if variant.tuned is not None]
    return [
        _begin(run),
        *(_judge(run, variant) for variant in first),
        _record(run),
        *([_measure(run), _diagnose(run)] if run.loop.hidden else []),
        *(_fit(run, model) for model in run.loop.models),
        *(_tune(run, variant) for variant in later),
        *(_judge(run, variant) for variant in later),
        _replay(run),
    ]


def _begin(run: LoopRun) -> Stage:
    """Train the first policy, or copy a shipped one or a checkpoint."""
    config, given = run.config, run.config.policy
    if given is None:
        assert isinstance(config, DeltaLoopConfig)

        def train(folder: Path) -> None:
            training.train(config.training, folder, run.console)

        needs = training.estimate(config.training)
        return Stage("train", "training the first policy", needs, train)

    def copy(folder: Path) -> None:
        with replacing_folder(folder / "policy") as new:
            shutil.copytree(checkpoint_folder(given), new, dirs_exist_ok=True)

    return Stage("given", f"taking {given} instead of training", Estimate(0, 0), copy)


def _flying(run: LoopRun, trials: int, simulator: str) -> Estimate:
    """Return the approximate time and memory of `trials` in `simulator`."""
    return flying_needs(trials, workers_for(trials, run.workers, simulator), simulator)


def _evaluation(run: LoopRun, variant: Variant) -> Evaluation:
    config = run.config
    return Evaluation(
        policies=(str(run.policy(variant)),),
        track=config.track,
        difficulty=config.difficulty,
        trials=config.trials,
        seed=config.seed,
        vehicle=config.vehicle if variant.simulated else config.true_vehicle,
        simulator=OWN[0] if variant.simulated else config.true_simulator,
        sensors=config.sensors,
    )


def _judge(run: LoopRun, variant: Variant) -> Stage:
    def work(folder: Path) -> None:
        evaluate(_evaluation(run, variant), folder, Quiet(), run.workers)

    def tell(folder: Path) -> None:
        rows = read_trials(folder / "trials.parquet")
        won = sum(row.success for row in rows) / len(rows)
        gates = sum(row.gates_passed for row in rows) / len(rows)
        words = f"{won:.0%} of {len(rows)} trials succeed, {gates:.1f} gates on average"
        run.console.note(f"    {words}")

    judged = run.config.trials * run.config.cells
    needs = _flying(run, judged, _evaluation(run, variant).simulator)
    return Stage(f"eval-{variant.name}", variant.judged, needs, work, tell)


def _record(run: LoopRun) -> Stage:
    config = run.config
    first = next(variant for variant in run.loop.variants if variant.name == BEFORE)
    collection = Collection(
        policy=str(run.policy(first)),
        track=config.track,
        difficulty=config.difficulty,
        trials=config.flights,
        vehicle=config.true_vehicle,
        simulator=config.true_simulator,
        sensors=config.sensors,
        seed=config.recorded_from,
    )
    return Stage(
        "flights",
        "recording flights on other seeds",
        _flying(run, config.flights * config.cells, config.true_simulator),
        lambda folder: collect(collection, folder, Quiet(), run.workers),
    )


def _measure(run: LoopRun) -> Stage:
    def work(folder: Path) -> None:
        try:
            files = measure(run.out / "flights", folder, run.config.seed)
        except ValueError as error:
            raise WorkFailed(
                f"{error}; record more flights (--flights) with another --out"
            ) from error
        chosen = [file.name for file in enough(files, DIAGNOSED_S)]
        write_json(folder / "diagnosed.json", {"files": chosen})

    words = "cutting the flights before contact, with a log's noise"
    needs = Estimate(1 + 0.05 * run.config.flights * run.config.cells, 0)
    return Stage("measured", words, needs, work)


def _diagnose(run: LoopRun) -> Stage:
    def work(folder: Path) -> None:
        from suite.diagnose.run import diagnose_files

        listed = json.loads((run.logs / "diagnosed.json").read_text(encoding="utf-8"))
        paths = [run.logs / name for name in listed["files"]]
        try:
            diagnose_files(
                paths,
                run.config.vehicle,
                folder,
                run.console,
                drive=INPUT_SOURCE,
                seed=run.config.seed,
            )
        except ValueError as error:
            raise WorkFailed(f"the flights in {run.logs} cannot be diagnosed: {error}") from error

    def tell(folder: Path) -> None:
        found = read_diagnosis(run.out)
        run.console.note(f"    {found['verdict']}: {named_effects(found) or 'nothing named'}")
        if not found["effects"]:
            raise WorkFailed(
                f"the diagnosis says {found['verdict']} and names nothing to correct, see "
                f"{folder / 'report.html'}; record more flights (--flights) with another --out"
            )

    words = "diagnosing what the vehicle file lacks"
    return Stage("diagnosis", words, DIAGNOSIS, work, tell)


def read_diagnosis(out: Path) -> dict[str, Any]:
    """Return what the diagnosis.json of the loop in `out` holds."""
    return json.loads((out / "diagnosis" / "diagnosis.json").read_text(encoding="utf-8"))


def named_effects(found: Mapping[str, Any]) -> str:
    """Return the effects that diagnosis.json names, with their rivals, in words."""
    parts = []
    for effect in found["effects"]:
        rivals = ", ".join(effect["alternatives"])
        parts.append(effect["name"] + (f" (or {rivals})" if rivals else ""))
    return ", ".join(parts)


def _fit(run: LoopRun, model: DeltaModel) -> Stage:
    fit = run.config.fit

    def work(folder: Path) -> None:
        tuning = run.tuning(model.diagnosed)
        try:
            fit_delta(fit, tuning.quadrotor or tuning.physics, [run.logs], folder, run.console)
        except ValueError as error:
            raise WorkFailed(
                f"the Delta Action Model cannot be fitted to the flights in {run.logs}: {error}; "
                + run.loop.advice
            ) from error

    def tell(folder: Path) -> None:
        for line in (folder / "table.md").read_text(encoding="utf-8").splitlines():
            run.console.note(f"    {line}")

    tuning = run.config.tuning
    through_quadrotor = tuning.quadrotor is not None
    steps = fit.horizon_s * (PHYSICS_HZ if through_quadrotor else tuning.spec.rate_hz)
    needs = fitting_estimate(fit, steps, through_quadrotor)
    return Stage(model.folder, model.words, needs, work, tell)


class Tuning(NamedTuple):
    """A fine-tuning, by content."""

    config: TrainConfig
    start: Mapping[str, np.ndarray]
    """Where it starts."""
    delta: Mapping[str, np.ndarray] | None
    """The Delta Action network that corrects what it goes through."""


def _tune(run: LoopRun, variant: Variant) -> Stage:
    """Fine-tune a policy; the first of such stages fine-tunes those of all where several work."""

    def work(folder: Path) -> None:
        several = run.workers is not None and run.workers != 1
        later = [v for v in run.loop.variants if v.tuned is not None] if several else [variant]
        jobs = [Job(_tuning(run, each), run.out / f"tuned-{each.name}") for each in later]
        jobs = [job for job in jobs if not is_done(job.folder)]
        all_done(_tune_one, jobs, run.workers, run.console, "fine-tuning")

    needs = training.estimate(run.config.tuning)
    return Stage(f"tuned-{variant.name}", f"fine-tuning {variant.tuned}", needs, work)


def _tuning(run: LoopRun, variant: Variant) -> Tuning:
    """Return what a variant is fine-tuned from and through."""
    tuning, first = run.tuning(variant.diagnosed), replace(variant, tuned=None)
    start = training.started_from(str(run.policy(first)), tuning.spec)
    delta = None
    if variant.delta is not None:
        delta = load_delta(run.out / variant.delta / "delta").params
    return Tuning(tuning, jax.tree.map(np.asarray, start), delta)


def _tune_one(job: Job, console: Console) -> None:
    tuning: Tuning = job.task
    start, delta = jax.tree.map(jnp.asarray, (tuning.start, tuning.delta))
    training.train(tuning.config, job.folder, console, start, delta)


def _replay(run: LoopRun) -> Stage:
    """Fly the first seed on every track, at the easiest and the hardest level, again.

    Trials are chosen by their seed, not by how they went; in the recording each is followed by the
    same one flown by the other policy.
    """
    by_name = {variant.name: variant for variant in run.loop.variants}
    evaluation = _evaluation(run, by_name[BEFORE])
    levels = parse_levels(run.config.difficulty)
    ends = replace(evaluation, difficulty=f"{min(levels)},{max(levels)}")

    def work(folder: Path) -> None:
        from eval.view.picture import write_grid
        from eval.view.recording import write_recording

        trials, flown, drone = first_trials(ends), [], None
        columns = len(set(trial.difficulty for trial in trials))
        for variant, label, _ in run.loop.shown:
            policy = str(run.policy(by_name[variant]))
            rollouts, drone = fly_again(evaluation, trials, policy)
            flown.append([(*pair, result._replace(policy=label)) for *pair, result in rollouts])
            write_grid(folder / f"{variant}.png", flown[-1], columns)
        pairs = [rollout for pair in zip(*flown, strict=True) for rollout in pair]
        write_recording(folder.parent / "recording.rrd", pairs, drone)

    words = "flying a few trials again for the recording and the pictures"
    return Stage("replays", words, _flying(run, 12, evaluation.simulator), work)

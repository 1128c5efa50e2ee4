"""The stages of a loop: train, judge, record, diagnose, fit, fine-tune, judge again, replay.

Each function below `plan` returns one `Stage`, whose work runs in its own folder.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from eval.judging.results import read_trials
from eval.logs.faults.catalogue import FAULTS
from eval.logs.faults.checked import CheckedFlights
from eval.logs.flight_log import flight_files, read_flights
from eval.quadrotor.vehicle_file import load_vehicle
from policies.formats.policy_file import load_delta, load_policy_checkpoint
from suite.common.console import Console, Quiet
from suite.common.errors import WorkFailed
from suite.common.running.remote import Job
from suite.common.stages import Estimate, Stage, is_done
from suite.common.work import do_jobs
from suite.delta.run import errors_grid, fit_delta, fitting_estimate
from suite.judging.collect import collect
from suite.judging.evaluate import evaluate
from suite.judging.flying import checkpoint_folder, flying_estimate, workers_for
from suite.judging.replay import first_trials, fly_again
from suite.judging.requests import Collection, Evaluation
from suite.judging.trials import parse_levels
from suite.loop.compare import BEFORE
from suite.loop.config import EXACT_SIMULATORS, LoopConfig
from suite.loop.measured import SHORTEST_S, add_measurement_noise, first_files
from suite.loop.variants import DeltaModel, Loop, Variant
from suite.train import run as training
from suite.train.config import TrainConfig
from tracks.common.files import replacing_folder, write_json
from tracks.common.grid import markdown
from tracks.common.work import Workers

DIAGNOSED_S = 80.0
"""Approximate total length of the flights that are diagnosed [s]."""
INPUT_SOURCE = "commands"
"""What drives the simulation in the diagnosis: the recorded commands, since the rate loop of the
flights is that of the vehicle file. With the recorded rotor speeds a wrong torque would make the
simulated flights diverge within a second."""
DIAGNOSIS = Estimate(90.0, 1.5e9)
"""Time and memory of a diagnosis."""
PHYSICS_HZ = 200.0
"""Physics steps of the quadrotor in a fit of the Delta Action Model, for the estimate [Hz]."""


@dataclass(frozen=True)
class LoopRun:
    """A loop in its folder."""

    loop: Loop
    config: LoopConfig
    out: Path
    console: Console
    workers: Workers | None = None
    """Number of processes (or a cluster) that fly and fine-tune. None: as many processes as shorten
    the flights, and one fine-tuning after the other."""

    @property
    def logs(self) -> Path:
        """The folder of the flights that fits and the diagnosis use."""
        return self.out / ("measured" if self.loop.hidden else "flights")

    def policy(self, variant: Variant) -> Path:
        """Return the folder of a variant's policy."""
        first = "train" if self.config.policy is None else "given"
        return self.out / (f"tuned-{variant.name}" if variant.tuned else first) / "policy"

    def tuning(self, diagnosed: bool) -> TrainConfig:
        """Return the settings of a fine-tuning; if `diagnosed`, with the corrected vehicle file."""
        tuning = self.config.tuning
        if not diagnosed or tuning.quadrotor is None:
            return tuning
        vehicle = load_vehicle(self.out / "diagnosis" / "vehicle.toml")
        return replace(tuning, quadrotor=replace(tuning.quadrotor, vehicle=vehicle))


def plan(run: LoopRun) -> list[Stage]:
    """Return the stages of a loop in order. Each first checks that no file has changed."""
    first = [variant for variant in run.loop.variants if variant.tuned is None]
    later = [variant for variant in run.loop.variants if variant.tuned is not None]
    stages = [
        _first_policy_stage(run),
        *(_judging_stage(run, variant) for variant in first),
        _recording_stage(run),
        *([_measuring_stage(run), _diagnosis_stage(run)] if run.loop.hidden else []),
        *(_fit_stage(run, model) for model in run.loop.models),
        *(_tuning_stage(run, variant) for variant in later),
        *(_judging_stage(run, variant) for variant in later),
        _replay_stage(run),
    ]
    return [
        replace(stage, work=partial(_on_same_files, run.config, stage.work)) for stage in stages
    ]


def _on_same_files(config: LoopConfig, work: Callable[[Path], Any], folder: Path) -> None:
    config.check_files()
    work(folder)


def _first_policy_stage(run: LoopRun) -> Stage:
    config, policy = run.config, run.config.policy
    if policy is None:

        def train(folder: Path) -> None:
            training.train(config.training, folder, run.console)

        estimate = training.estimate(config.training)
        return Stage("train", "training the first policy", estimate, train)

    def copy(folder: Path) -> None:
        with replacing_folder(folder / "policy") as new:
            shutil.copytree(checkpoint_folder(policy), new, dirs_exist_ok=True)

    return Stage("given", f"copying {policy} instead of training", Estimate(0, 0), copy)


def _estimate_flights(run: LoopRun, trials: int, simulator: str) -> Estimate:
    """Return the approximate time and memory of `trials` flights in `simulator`."""
    return flying_estimate(trials, workers_for(trials, run.workers, simulator), simulator)


def _evaluation(run: LoopRun, variant: Variant) -> Evaluation:
    config = run.config
    return Evaluation(
        policies=(str(run.policy(variant)),),
        track=config.track,
        difficulty=config.difficulty,
        trials=config.trials,
        seed=config.seed,
        vehicle=config.vehicle if variant.simulated else config.true_vehicle,
        simulator=EXACT_SIMULATORS[0] if variant.simulated else config.simulator,
        sensors=config.sensors,
    )


def _judging_stage(run: LoopRun, variant: Variant) -> Stage:
    def work(folder: Path) -> None:
        evaluate(_evaluation(run, variant), folder, Quiet(), run.workers)

    def show_result(folder: Path) -> None:
        rows = read_trials(folder / "trials.parquet")
        success = sum(row.success for row in rows) / len(rows)
        gates = sum(row.gates_passed for row in rows) / len(rows)
        run.console.note(
            f"    {success:.0%} of {len(rows)} trials succeed, {gates:.1f} gates on average"
        )

    count = run.config.trials * run.config.cells
    estimate = _estimate_flights(run, count, _evaluation(run, variant).simulator)
    return Stage(f"eval-{variant.name}", variant.judged, estimate, work, show_result)


def _recording_stage(run: LoopRun) -> Stage:
    config = run.config
    first = next(variant for variant in run.loop.variants if variant.name == BEFORE)
    collection = Collection(
        policy=str(run.policy(first)),
        track=config.track,
        difficulty=config.difficulty,
        trials=config.flights,
        vehicle=config.true_vehicle,
        simulator=config.simulator,
        sensors=config.sensors,
        seed=config.recorded_from,
    )
    return Stage(
        "flights",
        "recording flights on other seeds",
        _estimate_flights(run, config.flights * config.cells, config.simulator),
        lambda folder: collect(collection, folder, Quiet(), run.workers),
    )


def _measuring_stage(run: LoopRun) -> Stage:
    recorded = run.config.flights * run.config.cells

    def work(folder: Path) -> None:
        try:
            files = add_measurement_noise(run.out / "flights", folder, run.config.seed)
        except ValueError as error:
            raise WorkFailed(
                f"{error}; record more flights (--flights) with another --out"
            ) from error
        names = [file.name for file in first_files(files, DIAGNOSED_S)]
        write_json(folder / "diagnosed.json", {"files": names})

    def show_result(folder: Path) -> None:
        used, diagnosed = (
            len(json.loads((folder / name).read_text(encoding="utf-8"))["files"])
            for name in ("measured.json", "diagnosed.json")
        )
        run.console.note(
            f"    {used} of {recorded} flights last {SHORTEST_S:g} s or longer; {diagnosed} of "
            "them are diagnosed"
        )

    title = "adding measurement noise, and cutting the flights before contact"
    return Stage("measured", title, Estimate(1 + 0.05 * recorded, 0), work, show_result)


def _diagnosis_stage(run: LoopRun) -> Stage:
    def work(folder: Path) -> None:
        from suite.diagnose.config import Config
        from suite.diagnose.run import diagnose_files

        selected = json.loads((run.logs / "diagnosed.json").read_text(encoding="utf-8"))
        config = Config(
            flights=tuple(run.logs / name for name in selected["files"]),
            vehicle=run.config.vehicle,
            out=folder,
            drive=INPUT_SOURCE,
            seed=run.config.seed,
            accept=tuple(FAULTS),  # the suite itself wrote these logs
        )
        try:
            diagnose_files(config, run.console)
        except ValueError as error:
            raise WorkFailed(f"the flights in {run.logs} cannot be diagnosed: {error}") from error

    def show_result(folder: Path) -> None:
        diagnosis = read_diagnosis(run.out)
        effects = named_effects(diagnosis) or "nothing named"
        run.console.note(f"    {diagnosis['verdict']}: {effects}")
        if not diagnosis["effects"]:
            raise WorkFailed(
                f"the diagnosis has the verdict {diagnosis['verdict']} and names nothing to "
                f"correct, see {folder / 'report.html'}; record more flights (--flights) with "
                "another --out"
            )

    title = "diagnosing what the vehicle file lacks"
    return Stage("diagnosis", title, DIAGNOSIS, work, show_result)


def read_diagnosis(out: Path) -> dict[str, Any]:
    """Return the contents of diagnosis.json of the loop in `out`."""
    return json.loads((out / "diagnosis" / "diagnosis.json").read_text(encoding="utf-8"))


def named_effects(diagnosis: Mapping[str, Any]) -> str:
    """Return the effects that a diagnosis names as text, with alternatives ("A (or B), C")."""
    texts = []
    for effect in diagnosis["effects"]:
        alternatives = ", ".join(effect["alternatives"])
        texts.append(effect["name"] + (f" (or {alternatives})" if alternatives else ""))
    return ", ".join(texts)


def _fit_stage(run: LoopRun, model: DeltaModel) -> Stage:
    fit = run.config.fit

    def work(folder: Path) -> None:
        tuning = run.tuning(model.diagnosed)
        try:
            dynamics = tuning.quadrotor or tuning.physics
            # The suite itself wrote these logs, so they are not checked for wrong units and signs.
            logs, warnings = read_flights(flight_files([run.logs]))
            flights = CheckedFlights(logs, warnings=warnings)
            fit_delta(fit, dynamics, flights, folder, run.console)
        except ValueError as error:
            raise WorkFailed(
                f"the Delta Action Model cannot be fitted to the flights in {run.logs}: {error}; "
                + run.loop.advice
            ) from error

    def show_result(folder: Path) -> None:
        fitted = json.loads((folder / "delta.json").read_text(encoding="utf-8"))
        for line in markdown(errors_grid(fitted)).splitlines():
            run.console.note(f"    {line}")

    tuning = run.config.tuning
    through_quadrotor = tuning.quadrotor is not None
    steps = fit.horizon_s * (PHYSICS_HZ if through_quadrotor else tuning.spec.rate_hz)
    estimate = fitting_estimate(fit, steps, through_quadrotor)
    return Stage(model.folder, model.title, estimate, work, show_result)


class Tuning(NamedTuple):
    """A fine-tuning with its loaded inputs, so that a process on another machine can run it."""

    config: TrainConfig
    """Settings of the fine-tuning."""
    start: Mapping[str, np.ndarray]
    """Parameters of the policy at its start."""
    delta: Mapping[str, np.ndarray] | None
    """Parameters of the Delta Action network that corrects the actions; None without one."""


def _tuning_stage(run: LoopRun, variant: Variant) -> Stage:
    """Return the stage that fine-tunes a policy.

    With several workers the first of these stages fine-tunes all policies, in parallel.
    """

    def work(folder: Path) -> None:
        # One process fine-tunes the policy of this stage only; the later stages do the others.
        parallel = run.workers is not None and run.workers != 1
        tuned = [v for v in run.loop.variants if v.tuned is not None] if parallel else [variant]
        jobs = [Job(_tuning(run, each), run.out / f"tuned-{each.name}") for each in tuned]
        jobs = [job for job in jobs if not is_done(job.folder)]
        do_jobs(_tune_policy, jobs, run.workers, run.console, "fine-tuning")

    estimate = training.estimate(run.config.tuning)
    if isinstance(run.workers, int):
        count = sum(each.tuned is not None for each in run.loop.variants)
        together = max(1, min(run.workers, count))
        estimate = replace(estimate, memory_bytes=together * estimate.memory_bytes)
    return Stage(f"tuned-{variant.name}", f"fine-tuning {variant.tuned}", estimate, work)


def _tuning(run: LoopRun, variant: Variant) -> Tuning:
    """Return the fine-tuning of a variant, with its inputs loaded."""
    tuning, first = run.tuning(variant.diagnosed), replace(variant, tuned=None)
    start = training.start_params(load_policy_checkpoint(run.policy(first)), tuning.spec)
    delta = None
    if variant.delta is not None:
        delta = load_delta(run.out / variant.delta / "delta").arrays
    return Tuning(tuning, jax.tree.map(np.asarray, start), delta)


def _tune_policy(job: Job, console: Console) -> None:
    """Run one fine-tuning in its folder; the work of a process."""
    tuning: Tuning = job.task
    start, delta = jax.tree.map(jnp.asarray, (tuning.start, tuning.delta))
    training.train(tuning.config, job.folder, console, start, delta)


def _replay_stage(run: LoopRun) -> Stage:
    """Return the stage that flies a few trials again, for the recording and the pictures.

    They are the first trial of every track at the easiest and the hardest level, so they are not
    selected by their results. In the recording each trial of the first policy is followed by the
    same trial of the other one.
    """
    by_name = {variant.name: variant for variant in run.loop.variants}
    evaluation = _evaluation(run, by_name[BEFORE])
    levels = parse_levels(run.config.difficulty)
    extremes = replace(evaluation, difficulty=f"{min(levels)},{max(levels)}")

    def work(folder: Path) -> None:
        from eval.view.picture import write_grid
        from eval.view.recording import write_recording

        trials, drone = first_trials(extremes), None
        by_policy: list[list[Any]] = []
        columns = len(set(trial.difficulty for trial in trials))
        for variant, label, _ in run.loop.shown:
            policy = str(run.policy(by_name[variant]))
            rollouts, drone = fly_again(evaluation, trials, policy)
            labelled: list[Any] = [
                (*pair, result._replace(policy=label)) for *pair, result in rollouts
            ]
            by_policy.append(labelled)
            write_grid(folder / f"{variant}.png", labelled, columns)
        pairs = [rollout for pair in zip(*by_policy, strict=True) for rollout in pair]
        write_recording(folder.parent / "recording.rrd", pairs, drone)

    title = "flying a few trials again for the recording and the pictures"
    return Stage("replays", title, _estimate_flights(run, 12, evaluation.simulator), work)

"""Training and judging on an accelerator: speed, memory, a short training, the CPU's outcomes."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np

from eval.judging.judge import JudgeOptions, fly
from eval.judging.statistics import paired_success, wilson
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle
from eval.worlds.trial import Rules, TrialResult, TrialSpec
from policies.policy import load_policy
from suite.common.charts import DRAWN, curves_chart
from suite.common.console import Console
from suite.common.curve import read
from suite.common.report import Picture
from suite.experiments.pages.document import Made
from suite.experiments.pages.gpu_tables import (
    MODELS,
    judge_grid,
    pairs_grid,
    trainer_grid,
    training_grid,
)
from suite.experiments.study import judging
from suite.experiments.study.cache import Place
from suite.experiments.study.speed import best_time, count_operations, multiplying_rate, peak_memory
from suite.judging.flying import default_policy
from suite.train.config import TrainConfig
from suite.train.gradient import make_gradient
from suite.train.overrides import phase_configs, without_quadrotor
from suite.train.recipes import named_recipe, with_iterations
from suite.train.run import train
from suite.train.update import make_update, start_state
from suite.train.worlds import Worlds, sample_worlds
from tracks.common.grid import Grid
from tracks.common.work.processes import worker_pool
from tracks.families import JUDGED
from tracks.input.ranges import Range, Seed, Trials

LEVELS = (0, 3, 6, 9)
"""Levels of the trained policy's trials, and of the comparison with the CPU."""
SAMPLED, COUNTED = 128, 8
"""Number of different worlds in a speed measurement, which are repeated to its size; and of worlds
whose operations are counted."""
CPU_MOST = 256
"""Most worlds on a CPU: more take hours."""


@dataclass(frozen=True)
class Config:
    """Measure training and judging on this machine's accelerator, or on its CPU without one."""

    worlds: tuple[Annotated[int, Range(1, 10**6)], ...] = (256, 1024, 4096)
    """Worlds at once whose speed is measured, in the trainer and in the judge."""
    seconds: Annotated[float, Range(0.1, 36000.0)] = 100.0
    """Approximate length of the short training [s]."""
    train_worlds: Annotated[int, Range(1, 10**6)] = 1024
    """Worlds per gradient step of the short training, which follows the recipe gpu; one of
    --worlds."""
    trials: Trials = 60
    """Judged trials of the trained policy, over three tracks and levels 0, 3, 6 and 9."""
    paired_trials: Trials = 200
    """Trials that the shipped policy flies in mjx on the accelerator and on the CPU."""
    timed_s: Annotated[float, Range(0.1, 60.0)] = 2.0
    """Length of a trial in the judge's speed measurement [s]."""
    matrix: Annotated[int, Range(8, 65536)] = 8192
    """Size of the square matrices whose product shows the best speed of the device."""
    seed: Seed = 0
    """Seed of the training, and of the first judged trial."""


class Row(NamedTuple):
    """The trainer's speed for a number of worlds."""

    model: str
    """A key of MODELS."""
    worlds: int
    """Worlds in a gradient step."""
    seconds: float
    """Time of a gradient step [s]."""
    operations: float
    """Floating-point operations of a gradient step."""


def document(config: Config, place: Place, console: Console) -> Made:
    """Return tables, a chart and numbers.

    Raises:
        ValueError: if --train-worlds is not one of --worlds, and for too many worlds on a CPU.
    """
    if config.train_worlds not in config.worlds:
        raise ValueError(
            f"--train-worlds is {config.train_worlds}, allowed are those of --worlds: "
            f"{' '.join(map(str, config.worlds))}"
        )
    if jax.default_backend() == "cpu" and max(config.worlds) > CPU_MOST:
        raise ValueError(
            f"--worlds is {' '.join(map(str, config.worlds))}, but JAX finds no GPU here (see "
            "suite info): install '.[cuda]', or measure the CPU with --worlds 64 --train-worlds 64"
        )
    device, vehicle = jax.devices()[0], load_vehicle("reference")
    best = multiplying_rate(config.matrix)
    console.say(f"{device.device_kind}: {best / 1e12:.1f} TFLOP/s in a product of matrices")
    # Another process flies on the CPU at the same time.
    with worker_pool(1) as cpu_process:
        theirs = cpu_process.submit(flown_on_cpu, config, vehicle)
        programs = compiled(config, vehicle, console)
        rows = trainer_speeds(config, programs.updates, console)
        judge = [judge_speed(config, vehicle, worlds, console) for worlds in config.worlds]
        pairs = compared(programs.here, theirs.result(), console)
    step_s = {row.worlds: row.seconds for row in rows if row.model == "quadrotor"}
    short = short_training(config, vehicle, step_s[config.train_worlds], place, console)
    trainer = [row._asdict() for row in rows]
    memory = peak_memory()
    facts = {
        "device": f"{len(jax.devices())} x {device.device_kind}",
        "a product of matrices": f"{best / 1e12:.1f} TFLOP/s, float32 unrounded",
        "a gradient step": f"of the recipe gpu's last phase, {_steps(config)} decisions a world",
        "most memory held": "unknown" if memory is None else f"{memory / 1e9:.1f} GB",
        "compiling": f"{programs.seconds:.0f} s, all programs at once",
    }
    curve = Picture(curves_chart({"training": short["curve"]}), "The short training's curve")
    parts: dict[str, Sequence[Grid | Picture]] = {
        "Trainer": [trainer_grid(trainer, _steps(config), best)],
        "Judge": [judge_grid(judge)],
        "The same trials on the CPU": [pairs_grid(pairs)],
        "A short training": [curve, training_grid(short)],
    }
    numbers = {
        "device": device.device_kind,
        "multiplying_rate": best,
        "compile_s": programs.seconds,
        "memory_bytes": memory,
        "trainer": trainer,
        "judge": judge,
        "paired": pairs,
        "training": short,
    }
    return Made(facts, parts, numbers)


def recipe(config: Config, worlds: int) -> TrainConfig:
    """Return the recipe gpu for a number of worlds in one shard."""
    base = named_recipe("gpu")
    episode = replace(base.episode, batch=worlds, shards=1)
    return replace(base, episode=episode, seed=config.seed)


def last_phase(config: Config, model: str, worlds: int) -> TrainConfig:
    """Return the settings of the recipe's last phase for a model and a number of worlds."""
    phase = phase_configs(recipe(config, worlds))[-1]
    return without_quadrotor(phase) if model == "point" else phase


def _steps(config: Config) -> int:
    return last_phase(config, "quadrotor", 1).episode.steps


class Update(NamedTuple):
    """A compiled gradient step with its worlds."""

    phase: TrainConfig
    call: Callable[[], Any]


class Compiled(NamedTuple):
    """The compiled programs."""

    updates: Mapping[tuple[str, int], Update]
    """By model and number of worlds."""
    here: list[TrialResult]
    """Results of the trials that the CPU flies as well."""
    seconds: float
    """Time of compiling [s]."""


def compiled(config: Config, vehicle: Vehicle, console: Console) -> Compiled:
    """Run every program once, all at the same time, since compiling takes most of the time.

    The programs of the short training are among them, so that it need not compile them again.
    """
    wanted = {
        (model, worlds): last_phase(config, model, worlds)
        for worlds in config.worlds
        for model in MODELS
    }
    phases = phase_configs(recipe(config, config.train_worlds))
    began = time.perf_counter()
    with ThreadPoolExecutor(len(wanted) + len(phases) + len(config.worlds)) as pool:
        judged = [pool.submit(_timed, config, vehicle, worlds) for worlds in config.worlds]
        here = pool.submit(_flown, config, vehicle, "mjx")
        others = [pool.submit(_update, phase) for phase in phases[:-1]]
        updates = dict(zip(wanted, pool.map(_update, wanted.values()), strict=True))
        for one in (*judged, *others):
            one.result()
        found = Compiled(updates, here.result(), time.perf_counter() - began)
    console.say(f"every program compiled: {found.seconds:.0f} s")
    return found


def _update(phase: TrainConfig) -> Update:
    """Return a gradient step of a phase, after one call."""
    update, worlds = make_update(phase), repeated(phase)
    state = jax.device_put(start_state(phase), jax.devices()[0])
    jax.block_until_ready(update(state, worlds))
    return Update(phase, lambda: update(state, worlds))


def repeated(config: TrainConfig) -> Worlds:
    """Return the worlds of the first iteration, of which SAMPLED differ."""
    batch = config.episode.batch
    few = replace(config, episode=replace(config.episode, batch=min(batch, SAMPLED)))
    found = sample_worlds(few, 0)
    order = np.resize(np.arange(few.episode.batch), batch)
    return jax.tree.map(lambda leaf: leaf[order], found)._replace(number=np.arange(batch))


def trainer_speeds(
    config: Config, updates: Mapping[tuple[str, int], Update], console: Console
) -> list[Row]:
    """Return the speed of each gradient step, few worlds first."""
    each = {model: _operations_a_world(config, model) for model in MODELS}
    rows = []
    for (model, worlds), update in sorted(updates.items(), key=lambda entry: entry[0][1]):
        seconds = best_time(update.call)
        rows.append(Row(model, worlds, seconds, worlds * each[model]))
        console.say(f"trainer, {worlds} {MODELS[model]}: {seconds:.3f} s a gradient step")
    return rows


def _operations_a_world(config: Config, model: str) -> float:
    """Return the operations of the gradient for one world."""
    phase = last_phase(config, model, COUNTED)
    gradient = make_gradient(phase)
    given = (start_state(phase).params, repeated(phase), jax.random.key(0))
    return count_operations(lambda p, w, k: gradient(p, w, k, None)[0], *given) / COUNTED


def judge_speed(config: Config, vehicle: Vehicle, worlds: int, console: Console) -> dict[str, Any]:
    """Return the speed of mjx with `worlds` trials at once; making their tracks counts."""
    began = time.perf_counter()
    results = _timed(config, vehicle, worlds)
    seconds = time.perf_counter() - began
    flown_s = sum(result.time_s for result in results)
    console.say(f"judge, {worlds} trials at once: {seconds:.1f} s")
    return {
        "worlds": worlds,
        "seconds": seconds,
        "decisions_per_s": flown_s * load_policy(default_policy()).spec.rate_hz / seconds,
        "flown_s_per_s": flown_s / seconds,
    }


def _timed(config: Config, vehicle: Vehicle, worlds: int) -> list[TrialResult]:
    options = JudgeOptions(slots=worlds, workers=1, rules=Rules(time_limit_s=config.timed_s))
    trials = _trials(worlds, config.seed)
    return fly(load_policy(default_policy()), trials, vehicle, "mjx", options)


def _trials(count: int, seed: int) -> list[TrialSpec]:
    """Return trials over the three tracks and LEVELS in turn."""
    cells = [(track, level) for track in JUDGED for level in LEVELS]
    return [TrialSpec(*cells[k % len(cells)], seed + k // len(cells)) for k in range(count)]


def _flown(config: Config, vehicle: Vehicle, world: str) -> list[TrialResult]:
    options = JudgeOptions(slots=min(config.worlds), workers=1)
    trials = _trials(config.paired_trials, config.seed)
    return fly(load_policy(default_policy()), trials, vehicle, world, options)


def flown_on_cpu(config: Config, vehicle: Vehicle) -> dict[str, list[TrialResult]]:
    """Return the shipped policy's trials, flown on the CPU, by simulator."""
    jax.config.update("jax_platforms", "cpu")
    return {f"{world} on the CPU": _flown(config, vehicle, world) for world in ("mjx", "mujoco")}


def compared(
    here: Sequence[TrialResult], theirs: Mapping[str, Sequence[TrialResult]], console: Console
) -> dict[str, Any]:
    """Return how many of the shipped policy's trials end alike on the accelerator and the CPU."""
    found = {}
    for name, others in theirs.items():
        won, lost = (np.array([r.success for r in rows]) for rows in (here, others))
        found[name] = {
            "trials": len(here),
            "same_success": int((won == lost).sum()),
            "same_ending": sum(a.ended_by == b.ended_by for a, b in zip(here, others, strict=True)),
            "difference": paired_success(won, lost),
        }
        console.say(f"{found[name]['same_success']} of {len(here)} succeed or fail as in {name}")
    return found


def short_training(
    config: Config, vehicle: Vehicle, step_s: float, place: Place, console: Console
) -> dict[str, Any]:
    """Train by the recipe gpu for about `config.seconds`, and judge the policy.

    Args:
        config: of the experiment.
        vehicle: of the judged trials.
        step_s: time of a gradient step of the last phase; it determines how many are made [s].
        place: cache; an earlier run is removed, since the time is a result.
        console: shows progress.
    """
    wanted = recipe(config, config.train_worlds)
    phases = phase_configs(with_iterations(wanted, 1000))
    mean = sum(p.optimizer.iterations * p.episode.steps for p in phases) / 1000
    iterations = max(len(phases), round(config.seconds / step_s * _steps(config) / mean))
    folder = place.cache / "gpu"
    shutil.rmtree(folder, ignore_errors=True)
    began = time.perf_counter()
    outcome = train(with_iterations(wanted, iterations), folder, console)
    seconds = time.perf_counter() - began
    curve = read(folder)
    warm = [row for row in curve if not row["cold"]] or curve
    order = judging.Order(
        judging.Setup(str(outcome.policy), vehicle),
        _trials(config.trials, config.seed),
    )
    results = judging.flown({0: order}, place, console, "judging the short training")[0]
    fast = [result.v_max for result in results if result.success]
    return {
        "worlds": config.train_worlds,
        "iterations": iterations,
        "seconds": seconds,
        "decisions_per_s": float(np.median([row["steps_per_s"] for row in warm])),
        "success": wilson(sum(result.success for result in results), len(results)),
        "v_max": float(np.median(fast)) if fast else None,
        "curve": [{key: row[key] for key in ("iteration", *DRAWN, "loss")} for row in curve],
    }

"""The page `gpu`: speed of training and judging on an accelerator, and a check against the CPU."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Annotated, Any

import jax
import numpy as np

from eval.judging.judge import JudgeOptions, fly
from eval.judging.statistics import paired_success, wilson
from eval.judging.tables import percent
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import Vehicle
from eval.worlds.trial import Rules, TrialResult, TrialSpec
from policies.policy import load_policy
from suite.common.charts import DRAWN, curves_chart
from suite.common.console import Console
from suite.common.curve import read
from suite.common.report import Picture
from suite.experiments.pages.document import PageContents
from suite.experiments.study import judging
from suite.experiments.study.cache import Workspace
from suite.experiments.study.speed import best_time, count_operations, multiplying_rate, peak_memory
from suite.judging.flying import default_policy
from suite.train.config import TrainConfig
from suite.train.gradient import make_gradient
from suite.train.overrides import phase_configs, without_quadrotor
from suite.train.recipes import named_recipe, with_iterations
from suite.train.run import train
from suite.train.update import make_update, start_state
from suite.train.worlds import Worlds, sample_worlds
from tracks.common.grid import Grid, table_of
from tracks.common.work.processes import worker_pool
from tracks.families import JUDGED
from tracks.input.ranges import Range, Seed, Trials

LEVELS = (0, 3, 6, 9)
"""Levels of all judged trials: those of the trained policy and those of the comparison with the
CPU."""
SAMPLED, COUNTED = 128, 8
"""Number of different worlds in a measurement of the speed, in which further worlds are copies of
these; and number of worlds in the program whose operations are counted."""
MODELS = {"quadrotor": "quadrotors", "point": "point masses"}
"""Dynamics of the training: key -> name in tables."""
Numbers = Mapping[str, Any]
"""Measured values of one row of a table, by name."""
CPU_MOST = 256
"""Largest number of worlds that may be measured on a CPU: more take hours."""


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


def document(config: Config, workspace: Workspace, console: Console) -> PageContents:
    """Return the contents of the page, after all measurements.

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
            "suite info): pip install 'diffracing-suite[cuda]', or measure the CPU with "
            "--worlds 64 --train-worlds 64"
        )
    # 1. The best speed of the device, for comparison with the speed of the training.
    device, vehicle = jax.devices()[0], load_vehicle("reference")
    peak_rate = multiplying_rate(config.matrix)
    console.say(f"{device.device_kind}: {peak_rate / 1e12:.1f} TFLOP/s in a product of matrices")
    # 2. Compilation. Another process flies the same trials on the CPU at the same time.
    with worker_pool(1) as cpu_process:
        cpu_results = cpu_process.submit(fly_on_cpu, config, vehicle)
        started = time.perf_counter()
        updates, results = compile_programs(config, vehicle)
        compile_s = time.perf_counter() - started
        console.say(f"every program compiled: {compile_s:.0f} s")
        comparison = compare_with_cpu(results, cpu_results.result(), console)
    # 3. Training and judging, when the other process no longer takes time from them.
    trainer = trainer_speeds(config, updates, console)
    judge = [judge_speed(config, vehicle, worlds, console) for worlds in config.worlds]
    # 4. The short training.
    step_s = {row["worlds"]: row["seconds"] for row in trainer if row["model"] == "quadrotor"}
    short_result = short_training(config, vehicle, step_s[config.train_worlds], workspace, console)
    memory = peak_memory()
    facts = {
        "device": f"{len(jax.devices())} x {device.device_kind}",
        "a product of matrices": f"{peak_rate / 1e12:.1f} TFLOP/s, float32 unrounded",
        "a gradient step": f"of the recipe gpu's last phase, {_steps(config)} decisions per world",
        "most memory held": "unknown" if memory is None else f"{memory / 1e9:.1f} GB",
        "compiling": f"{compile_s:.0f} s, all programs at once",
    }
    curve = Picture(curves_chart({"training": short_result["curve"]}), "The short training's curve")
    parts: dict[str, Sequence[Grid | Picture]] = {
        "Trainer": [trainer_grid(trainer, _steps(config), peak_rate)],
        "Judge": [judge_grid(judge)],
        "The same trials on the CPU": [pairs_grid(comparison)],
        "A short training": [curve, training_grid(short_result)],
    }
    numbers = {
        "device": device.device_kind,
        "multiplying_rate": peak_rate,
        "compile_s": compile_s,
        "memory_bytes": memory,
        "trainer": trainer,
        "judge": judge,
        "paired": comparison,
        "training": short_result,
    }
    return PageContents(facts, parts, numbers)


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
    """Return the number of decisions of a world in a gradient step."""
    return last_phase(config, "quadrotor", 1).episode.steps


def compile_programs(
    config: Config, vehicle: Vehicle
) -> tuple[dict[tuple[str, int], Callable[[], Any]], list[TrialResult]]:
    """Run every program once, so that it is compiled before its time is measured.

    All compile at the same time, since compiling takes most of the time. The programs of the short
    training are among them, so that training does not compile them again.

    Returns:
        Gradient steps by model and number of worlds, and the results on this device of the trials
        that the CPU flies as well.
    """
    measured = {
        (model, worlds): last_phase(config, model, worlds)
        for worlds in config.worlds
        for model in MODELS
    }
    phases = phase_configs(recipe(config, config.train_worlds))
    with ThreadPoolExecutor(len(measured) + len(phases) + len(config.worlds)) as pool:
        judged = [pool.submit(_fly_timed, config, vehicle, worlds) for worlds in config.worlds]
        results = pool.submit(_fly_paired, config, vehicle, "mjx")
        earlier_phases = [pool.submit(_compile_update, phase) for phase in phases[:-1]]
        updates = dict(zip(measured, pool.map(_compile_update, measured.values()), strict=True))
        for future in (*judged, *earlier_phases):
            future.result()
        return updates, results.result()


def _compile_update(phase: TrainConfig) -> Callable[[], Any]:
    """Return a gradient step of a phase; one call of it is made, which compiles it."""
    update, worlds = make_update(phase), repeated_worlds(phase)
    state = jax.device_put(start_state(phase), jax.devices()[0])
    jax.block_until_ready(update(state, worlds))
    return lambda: update(state, worlds)


def repeated_worlds(config: TrainConfig) -> Worlds:
    """Return the worlds of the first iteration.

    At most SAMPLED of them are different, because drawing worlds is slow. The others are copies.
    """
    batch = config.episode.batch
    few = replace(config, episode=replace(config.episode, batch=min(batch, SAMPLED)))
    worlds = sample_worlds(few, 0)
    order = np.resize(np.arange(few.episode.batch), batch)
    return jax.tree.map(lambda leaf: leaf[order], worlds)._replace(number=np.arange(batch))


def trainer_speeds(
    config: Config, updates: Mapping[tuple[str, int], Callable[[], Any]], console: Console
) -> list[dict[str, Any]]:
    """Return model, worlds, seconds and operations of each gradient step, by number of worlds."""
    operations = {model: _operations_per_world(config, model) for model in MODELS}
    rows = []
    for (model, worlds), update in sorted(updates.items(), key=lambda entry: entry[0][1]):
        seconds = best_time(update)
        count = worlds * operations[model]
        rows.append({"model": model, "worlds": worlds, "seconds": seconds, "operations": count})
        console.say(f"trainer, {worlds} {MODELS[model]}: {seconds:.3f} s per gradient step")
    return rows


def _operations_per_world(config: Config, model: str) -> float:
    phase = last_phase(config, model, COUNTED)
    gradient = make_gradient(phase)
    arguments = (start_state(phase).params, repeated_worlds(phase), jax.random.key(0))
    return count_operations(lambda p, w, k: gradient(p, w, k, None)[0], *arguments) / COUNTED


def judge_speed(config: Config, vehicle: Vehicle, worlds: int, console: Console) -> dict[str, Any]:
    """Return the speed of mjx with `worlds` trials at once; the time includes making the tracks."""
    started = time.perf_counter()
    results = _fly_timed(config, vehicle, worlds)
    seconds = time.perf_counter() - started
    flown_s = sum(result.time_s for result in results)
    console.say(f"judge, {worlds} trials at once: {seconds:.1f} s")
    return {
        "worlds": worlds,
        "seconds": seconds,
        "decisions_per_s": flown_s * load_policy(default_policy()).spec.rate_hz / seconds,
        "flown_s_per_s": flown_s / seconds,
    }


def _fly_timed(config: Config, vehicle: Vehicle, worlds: int) -> list[TrialResult]:
    """Fly short trials in mjx, all at once."""
    options = JudgeOptions(slots=worlds, workers=1, rules=Rules(time_limit_s=config.timed_s))
    trials = _trials(worlds, config.seed)
    return fly(load_policy(default_policy()), trials, vehicle, "mjx", options)


def _trials(count: int, seed: int) -> list[TrialSpec]:
    """Return `count` trials, over the three tracks and LEVELS in turn; seeds begin at `seed`."""
    cells = [(track, level) for track in JUDGED for level in LEVELS]
    return [TrialSpec(*cells[k % len(cells)], seed + k // len(cells)) for k in range(count)]


def _fly_paired(config: Config, vehicle: Vehicle, simulator: str) -> list[TrialResult]:
    """Fly the shipped policy on the trials of the comparison between accelerator and CPU."""
    options = JudgeOptions(slots=min(config.worlds), workers=1)
    trials = _trials(config.paired_trials, config.seed)
    return fly(load_policy(default_policy()), trials, vehicle, simulator, options)


def fly_on_cpu(config: Config, vehicle: Vehicle) -> dict[str, list[TrialResult]]:
    """Return the shipped policy's trials, flown on the CPU, by simulator."""
    jax.config.update("jax_platforms", "cpu")
    return {f"{name} on the CPU": _fly_paired(config, vehicle, name) for name in ("mjx", "mujoco")}


def compare_with_cpu(
    here: Sequence[TrialResult], on_cpu: Mapping[str, Sequence[TrialResult]], console: Console
) -> dict[str, Any]:
    """Return how many trials have the same result on this device and on the CPU, by simulator."""
    comparisons = {}
    for name, others in on_cpu.items():
        success, cpu_success = (np.array([r.success for r in rows]) for rows in (here, others))
        same = int((success == cpu_success).sum())
        comparisons[name] = {
            "trials": len(here),
            "same_success": same,
            "same_ending": sum(a.ended_by == b.ended_by for a, b in zip(here, others, strict=True)),
            "difference": paired_success(success, cpu_success),
        }
        console.say(f"{same} of {len(here)} trials have the same success as in {name}")
    return comparisons


def short_training(
    config: Config, vehicle: Vehicle, step_s: float, workspace: Workspace, console: Console
) -> dict[str, Any]:
    """Train by the recipe gpu for about `config.seconds`, and judge the policy.

    The time `step_s` of a gradient step of the last phase [s] determines the number of steps. An
    earlier run is removed from the cache, since the time of the training is a result.
    """
    base = recipe(config, config.train_worlds)
    # Phases differ in the decisions of a gradient step, and its time is proportional to them. With
    # 1000 iterations in all, each phase counts with its share.
    phases = phase_configs(with_iterations(base, 1000))
    mean_decisions = sum(p.optimizer.iterations * p.episode.steps for p in phases) / 1000
    iterations = max(len(phases), round(config.seconds / step_s * _steps(config) / mean_decisions))
    folder = workspace.cache / "gpu"
    shutil.rmtree(folder, ignore_errors=True)
    started = time.perf_counter()
    outcome = train(with_iterations(base, iterations), folder, console)
    seconds = time.perf_counter() - started
    curve = read(folder)
    warm = [row for row in curve if not row["cold"]] or curve
    trials = _trials(config.trials, config.seed)
    request = judging.TrialRequest(str(outcome.policy), vehicle, trials)
    results = judging.fly_trials({0: request}, workspace, console, "judging the short training")[0]
    return {
        "worlds": config.train_worlds,
        "iterations": iterations,
        "seconds": seconds,
        "decisions_per_s": float(np.median([row["steps_per_s"] for row in warm])),
        "success": wilson(sum(result.success for result in results), len(results)),
        "v_max": float(np.median([result.v_max for result in results])),
        "curve": [{key: row[key] for key in ("iteration", *DRAWN, "loss")} for row in curve],
    }


def trainer_grid(rows: Sequence[Numbers], steps: int, best: float) -> Grid:
    """Return a table of the speed of training, a row per model and number of worlds.

    A row has model, worlds, seconds and operations of a gradient step, which is `steps` decisions
    of a world. `best` is the device's best speed in a matrix product [operations/s].
    """
    return table_of(
        rows,
        ("trains", lambda row: MODELS[row["model"]]),
        ("worlds", lambda row: f"{row['worlds']}"),
        ("decisions/s", lambda row: f"{row['worlds'] * steps / row['seconds']:,.0f}"),
        ("a gradient step [ms]", lambda row: f"{1e3 * row['seconds']:,.0f}"),
        ("TFLOP/s", lambda row: f"{row['operations'] / row['seconds'] / 1e12:.2f}"),
        (
            "share of the largest matrix-product speed",
            lambda row: f"{row['operations'] / row['seconds'] / best:.1%}",
        ),
    )


def judge_grid(rows: Sequence[Numbers]) -> Grid:
    """Return a table of the speed of the judge, a row per number of trials at once."""
    return table_of(
        rows,
        ("trials at once", lambda row: f"{row['worlds']}"),
        ("decisions/s", lambda row: f"{row['decisions_per_s']:,.0f}"),
        ("simulated seconds per second", lambda row: f"{row['flown_s_per_s']:,.0f}"),
        ("all of them [s]", lambda row: f"{row['seconds']:.1f}"),
    )


def pairs_grid(pairs: Mapping[str, Numbers]) -> Grid:
    """Return a table of the trials with the same result on CPU and accelerator.

    It has a row per simulator on the CPU.
    """

    def difference(row: Numbers) -> str:
        return "{:+.1f} ({:+.1f} to {:+.1f})".format(*(100 * x for x in row["difference"]))

    return table_of(
        [{"name": name, **numbers} for name, numbers in pairs.items()],
        ("compared with", lambda row: row["name"]),
        ("trials", lambda row: f"{row['trials']}"),
        ("the same success", lambda row: f"{row['same_success']}"),
        ("the same ending", lambda row: f"{row['same_ending']}"),
        ("success, GPU minus CPU [points, 95 %]", difference),
    )


def training_grid(short: Numbers) -> Grid:
    """Return a table of one row with the results of the short training."""
    return table_of(
        [short],
        ("worlds", lambda row: f"{row['worlds']}"),
        ("gradient steps", lambda row: f"{row['iterations']}"),
        ("time with compiling [s]", lambda row: f"{row['seconds']:.0f}"),
        ("decisions/s", lambda row: f"{row['decisions_per_s']:,.0f}"),
        ("success (95 %)", lambda row: percent(row["success"])),
        ("v_max, median [m/s]", lambda row: f"{row['v_max']:.1f}"),
    )

"""Train a policy by backpropagation through differentiable dynamics; estimate how long it takes.

Further functions return warnings about settings that are allowed, but are probably mistakes.
A run is one training; a phase is a part of it with its own settings. `train` describes the phases
to the loop of `training_loop.py`, which iterates, saves and resumes in a folder. Simulated scenes
and noise depend only on the seed and the iteration.
"""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable, Mapping
from operator import attrgetter
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from eval.effects import without_signal
from policies.formats.policy_file import PolicyCheckpoint
from policies.networks import delta_network, network
from policies.spec import PolicySpec
from suite.common.console import Console, counted
from suite.common.curve import Mirror
from suite.common.running import hosts
from suite.common.stages import Estimate
from suite.train.config import TrainConfig
from suite.train.overrides import check_phases, path_of, phase_configs, phase_ends, phase_of
from suite.train.shards import check_processes
from suite.train.training_loop import Outcome, Run, RunPhase, Watch, flight_note, train_in_folder
from suite.train.update import make_update, start_state
from suite.train.worlds import sample_worlds
from tracks.common.files import plain
from tracks.common.work import usable_cores
from tracks.common.work.threads import threads

STEPS_PER_CORE_S = 5000.0
"""Environment steps (decisions of one simulated drone) a second of a processor core, gradient
included; for the estimate."""
COMPILE_S = 15.0
"""Time to compile, for the estimate [s]."""
PROGRAM_BYTES, FLOATS_PER_UNIT = 8e8, 24
"""Memory of the process without a batch [byte], and number of stored floats for each unit of the
recurrent state and each environment step; for the estimate."""


def estimate(
    config: TrainConfig,
    steps_per_core_s: float = STEPS_PER_CORE_S,
    compile_s: float = COMPILE_S,
    passes: int = 1,
    images: int = 2,
) -> Estimate:
    """Return the approximate time and memory of a run on this machine's devices.

    A processor core makes `steps_per_core_s` environment steps with gradient [1/s], and a phase
    compiles in `compile_s` [s]. An iteration makes `passes` over its steps, and needs memory for
    `images` copies of its images.
    """
    pixels = config.spec.camera.height * config.spec.camera.width
    # An accelerator counts as 50 cores, a rough value.
    cores = usable_cores() if jax.default_backend() == "cpu" else 50
    seconds, most_frames = 0.0, 0
    for phase in phase_configs(config):
        frames = phase.episode.batch * phase.episode.steps
        steps = phase.optimizer.iterations * frames * passes
        seconds += compile_s + steps / (steps_per_core_s * cores)
        most_frames = max(most_frames, frames)
    floats = most_frames * (images * pixels + FLOATS_PER_UNIT * config.spec.hidden_size)
    return Estimate(seconds, PROGRAM_BYTES + floats * 4.0)  # 4 bytes a float


def warmup_warnings(config: TrainConfig) -> list[str]:
    """Return a warning for each phase that ends before its learning rate reaches the peak."""
    ends, phases = phase_ends(config), phase_configs(config)
    counts = (end - begin for begin, end in zip((0, *ends), ends, strict=False))
    return [
        (f"phase {number} of {len(phases)}: " if config.phases else "")
        + f"{counted(count, 'gradient step')}, not more than the warm-up (optimizer.warmup "
        f"{phase.optimizer.warmup}), so the learning rate stays below its peak; give more "
        "iterations or a smaller optimizer.warmup"
        for number, (phase, count) in enumerate(zip(phases, counts, strict=True), 1)
        if count <= phase.optimizer.warmup
    ]


def rate_loop_warnings(config: TrainConfig) -> list[str]:
    """Return a warning if the rate loop overshoots at every physics step of the training."""
    for quadrotor in (phase.quadrotor for phase in phase_configs(config) if phase.quadrotor):
        controller, hz = quadrotor.vehicle.controller, quadrotor.physics_hz
        if controller.overshoots(1.0 / hz):
            return [
                f"vehicle {quadrotor.vehicle.name!r}: controller.rate_gain has "
                f"{max(controller.rate_gain):g} 1/s, too fast for the training's {hz:g} physics "
                f"steps a second; give --set quadrotor.physics_hz={controller.frequency:g}"
            ]
    return []


def change_warnings(config: TrainConfig, changes: Iterable[str]) -> list[str]:
    """Return warnings about a user's `changes`, which are made in `config` already.

    A later phase may undo a change, and a tilt has no gradient through a point mass.
    """
    # (number of the phase from which a change holds, path of the setting)
    given = [
        (int(number or 1), path_of(rest))
        for number, rest in (phase_of(change.strip()) for change in changes)
    ]
    configs, warnings = phase_configs(config), []
    for first, path in given:
        value = attrgetter(path)(configs[first - 1])
        for number, phase in enumerate(configs[first:], first + 1):
            if (number, path) in given:
                break
            if (other := attrgetter(path)(phase)) != value:
                warnings.append(
                    f"{path} is {value!r} until phase {number} of {len(configs)}, which sets it to "
                    f"{other!r}; to keep it, give phases.{number}.{path} as well, or {path} for "
                    "all phases"
                )
                break
        if path == "loss.tilt" and value > 0.0 and config.quadrotor is None:
            warnings.append(
                "loss.tilt has no gradient through the point mass, which has no attitude: it only "
                "leaves out worlds that tilt beyond 90 degrees; train through quadrotors (suite "
                "train: add --model quad and --vehicle), or leave loss.tilt out"
            )
    return warnings


def start_params(start: PolicyCheckpoint, spec: PolicySpec) -> network.Params:
    """Return the parameters of a policy to start a training from, converted to `spec`.

    Raises:
        ValueError: if the policy has an input that `spec` lacks.
    """
    return network.adapt_params(jax.tree.map(jnp.asarray, start.params), start.spec, spec)


def train(
    config: TrainConfig,
    folder: Path,
    console: Console,
    params: network.Params | None = None,
    delta: delta_network.Params | None = None,
    watch: Watch | None = None,
    mirror: Mirror | None = None,
) -> Outcome:
    """Train for the configured iterations; the same call again resumes the run in `folder`.

    `params` replace random initial parameters. `delta` are parameters of a Delta Action network,
    which are not trained. It corrects every action so that simulated flights match measured ones.
    `watch` measures the policy during the training, in a single process only. `mirror` also
    receives the rows of the learning curve.

    Raises:
        ValueError: for invalid settings, if the folder has a run of another configuration, start or
            delta, and if processes have different settings.
        WorkFailed: if the loss or the parameters are not finite, or another process has ended.
    """
    check_phases(config)
    check_processes(config)
    # What must be the same to resume a run, and in all processes that train together.
    origin = {"config": plain(config), "from": _digest(params), "delta": _digest(delta)}
    hosts.check_same({"the configuration": origin["config"], "--init-from": origin["from"],
                 "--delta": origin["delta"], "threads": threads() > 1})  # fmt: skip
    configs, ends = phase_configs(config), phase_ends(config)
    if configs[0].quadrotor is not None:
        for note in without_signal(configs[0].quadrotor.vehicle):
            console.note(note)
    begins = (0, *ends[:-1])
    phases = [
        RunPhase(
            end=end,
            spec=phase.spec,
            frames=phase.episode.batch * phase.episode.steps,
            worlds=functools.partial(sample_worlds, phase),
            make_update=functools.partial(make_update, phase, delta, begin),
            note=functools.partial(flight_note, "loss"),
        )
        for phase, begin, end in zip(configs, begins, ends, strict=True)
    ]
    run = Run(config, origin, folder, estimate(config), mirror)
    return train_in_folder(phases, run, start_state(configs[0], params), console, watch)


def _digest(params: Mapping[str, Any] | None) -> str | None:
    """Return the SHA-256 of a network's parameters; None for none."""
    if params is None:
        return None
    digest = hashlib.sha256()
    for name in sorted(params):
        digest.update(name.encode() + np.asarray(params[name], order="C").tobytes())
    return digest.hexdigest()

"""Run a training in a folder: iterate, save checkpoints that survive a kill, resume exactly.

A run is one training, an iteration is one update of the policy, a phase is a part of a run with its
own settings. The run's folder has run.json (settings and versions), metrics.jsonl (the learning
curve, a row per iteration), validation.jsonl (measurements during the training), policy/ (the
checkpoint to fly) and state/ (for resuming). An iteration depends only on the state and its number,
so a resumed run has the same curve as one without a stop. Both trainers, the differentiable one and
PPO, use this module.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from policies.formats.checkpoint import load_arrays, read_config, save_arrays
from policies.formats.policy_file import load_policy_checkpoint, save_policy
from policies.networks import network
from policies.networks.tree_arrays import tree_from_arrays, tree_to_arrays
from policies.spec import PolicyError, PolicySpec
from suite.common import curve
from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.common.provenance import refuse_other_run, write_run_record
from suite.common.running import hosts
from suite.common.stages import Estimate, announce
from suite.train.worlds import Worlds, WorldsAhead
from tracks.common.files import recover_folder
from tracks.common.provenance import differences, first_changes
from tracks.common.work.threads import threads

SAVE_PERIOD_S = 30.0
"""Time between checkpoints [s]."""


@dataclass(frozen=True)
class Outcome:
    """The result of a run."""

    policy: Path
    """The trained policy's checkpoint."""
    iterations: int
    """Number of iterations of the run, with those before an interruption."""
    last: dict[str, Any]
    """Numbers of the learning curve by name, means over its last tenth."""


class Watch(NamedTuple):
    """A measurement of the policy during the training; its time does not count as training."""

    every: int
    """Number of iterations between measurements. The policy is also measured before the first
    iteration and after the last one."""
    measure: Callable[[network.Params], Mapping[str, float]]
    """(the policy's parameters) -> a row of validation.jsonl."""


class RunPhase(NamedTuple):
    """The functions of one phase of a run.

    They work on the trainer's state, which has at least the policy's `params` and the number of
    finished iterations, `iteration`.
    """

    end: int
    """Iteration of the run at which the phase ends; it begins at the end of the phase before."""
    spec: PolicySpec
    """Spec of the policy during the phase; the parameters are converted if it changes."""
    frames: int
    """Number of environment steps (decisions, over all simulated drones) in one iteration."""
    worlds: Callable[[int], Worlds]
    """(iteration) -> its worlds, the simulated scenes and drones."""
    make_update: Callable[[], Callable[[Any, Worlds], tuple[Any, dict[str, jax.Array]]]]
    """Returns update(state, worlds) -> (new state, row of the curve); called once in a phase."""
    note: Callable[[Mapping[str, float]], str]
    """(row of the curve) -> a short text about it, for the progress line."""


def flight_note(goal: str, row: Mapping[str, float]) -> str:
    """Return a row of the curve as a short text: the number `goal`, gates, collisions and speed."""
    return (
        f"{goal} {row[goal]:.2f}, gates {row['gates']:.2f}, collided {row['collided']:.0%}, "
        f"{row['speed']:.1f} m/s"
    )


class Run(NamedTuple):
    """A run: its settings, its folder, and what must be the same to resume it."""

    config: Any
    """All settings, a dataclass with the `seed` of the run."""
    origin: dict[str, Any]
    """The inputs, such as "config", that must be the same to resume the run of a folder."""
    folder: Path
    """Where the run's files go."""
    estimate: Estimate
    """Time and memory of the whole run."""
    mirror: curve.Mirror | None = None
    """A function that also receives the rows of the curve."""


def train_in_folder(
    phases: Sequence[RunPhase], run: Run, fresh: Any, console: Console, watch: Watch | None = None
) -> Outcome:
    """Run the updates of all phases to the end, from the state saved in the folder.

    Without a saved state they start from `fresh`. If several processes train together, the first
    one reads and writes the folder, and sends its state to the others.

    Raises:
        ValueError: if the folder has another run.
        WorkFailed: if a number of the curve is not finite, or another process has ended.
    """
    folder = run.folder
    if hosts.is_writer():
        refuse_other_run(folder, run.config)
        fresh = _resume(run, fresh)
    # The state must be on the device of the update; otherwise the second iteration compiles again.
    state = jax.device_put(hosts.broadcast_from_first(fresh), jax.local_devices()[0])
    done, total = int(state.iteration), phases[-1].end
    if not hosts.is_writer():
        return Outcome(folder / "policy", int(_iterate(phases, run, state, console).iteration), {})
    if done < total or _is_missing(watch, folder, done, total):
        title = f"training to {folder}" + (f" from step {done} of {total} on" if done else "")
        seconds = run.estimate.seconds * (total - done) / total
        announce(console, title, replace(run.estimate, seconds=seconds))
        if done < total:
            changes = write_run_record(folder, run.config, run.config.seed, resumed=done > 0)
            if changes:
                console.note(
                    f"warning: {folder} was trained until here with other versions "
                    f"({first_changes(changes)}), so the result may differ from that of one "
                    "version; run.json names both; give another --out to train all of it with these"
                )
        state = _iterate(phases, run, state, console, watch)
    else:
        console.note(
            f"{folder} holds this training, finished: nothing is trained; to train its policy "
            f"further, give another --out with --init-from {folder / 'policy'}"
        )
        try:
            load_policy_checkpoint(folder / "policy")
        except PolicyError:  # missing or damaged: the state has the same weights
            _save(run, _last_phase(phases, done), state)
    # The outcome, from the last tenth of the curve.
    rows = curve.read(folder)
    if not rows or rows[-1]["iteration"] + 1 < total:
        raise ValueError(
            f"{folder} holds a finished training without the end of its curve, metrics.jsonl: put "
            f"that back, use {folder / 'policy'} as it is, or give another --out"
        )
    last = rows[-max(1, len(rows) // 10) :]
    means = {key: float(np.mean([row[key] for row in last])) for key in last[0]}
    return Outcome(folder / "policy", int(state.iteration), means)


def _iterate(
    phases: Sequence[RunPhase], run: Run, state: Any, console: Console, watch: Watch | None = None
) -> Any:
    """Return the state after the last phase; phases that are already finished are skipped."""
    total, first = phases[-1].end, int(state.iteration)
    with (
        console.progress("training", total, begun=first) as show,
        _Recorder(run, watch, total) as recorder,
        WorldsAhead() as ahead,
    ):
        # Something to save if the run is interrupted before the first iteration ends.
        recorder.last = (_last_phase(phases, first), state)
        if _is_missing(watch, run.folder, first, total):
            recorder.measure_if_due(state)
        beginning, spec = 0, phases[0].spec
        for phase in phases:
            # A run that is resumed within a phase has its converted state already. A phase without
            # iterations converts the state, too: the next phase converts from its spec.
            if int(state.iteration) == beginning and spec != phase.spec:
                params = network.adapt_params(state.params, spec, phase.spec)
                state = state._replace(params=params)
            if int(state.iteration) < phase.end:
                state = _iterate_phase(phase, state, recorder, show, ahead)
            beginning, spec = phase.end, phase.spec
    return state


def _last_phase(phases: Sequence[RunPhase], done: int) -> RunPhase:
    """Return the phase of the last of `done` iterations."""
    return next(phase for phase in phases if done <= phase.end)


def _iterate_phase(
    phase: RunPhase,
    state: Any,
    recorder: _Recorder,
    show: Callable[[int, str], None],
    ahead: WorldsAhead,
) -> Any:
    """Return the state after the phase; every iteration is recorded and shown."""
    first = int(state.iteration)
    update = phase.make_update()
    started = time.monotonic()
    for iteration, worlds in ahead.worlds(phase.worlds, first, phase.end):
        with _lost_process_explained(iteration, recorder.run.folder):
            state, numbers = update(state, worlds)
            row = {key: float(value) for key, value in numbers.items()}
        _check_finite(iteration, row, recorder.run.folder)
        seconds = time.monotonic() - started
        speed = phase.frames / seconds
        # The time of a cold iteration, the first one, includes compiling.
        clock = {"seconds": round(seconds, 4), "cold": iteration == first}
        row = {"iteration": iteration, **row, "steps_per_s": round(speed), **clock}
        recorder.add(phase, state, row)
        show(iteration + 1, f"{phase.note(row)}, {speed:.0f} steps/s")
        started = time.monotonic()
    return state


class _Recorder:
    """Writes a run's curve and checkpoints, regularly and at the end."""

    def __init__(self, run: Run, watch: Watch | None, total: int) -> None:
        self.run, self.watch, self.total = run, watch, total
        self.rows: list[dict[str, Any]] = []
        self.measurements: list[dict[str, Any]] = []
        self.last: tuple[RunPhase, Any] | None = None
        self.saved_at = time.monotonic()

    def __enter__(self) -> _Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.save()

    def add(self, phase: RunPhase, state: Any, row: dict[str, Any]) -> None:
        """Add the row of an iteration and the state after it."""
        # The row is added before the state. If the run is interrupted between the two, resuming
        # removes the extra row; a missing row could not be restored.
        self.rows.append(row)
        self.last = (phase, state)
        self.measure_if_due(state)
        if time.monotonic() - self.saved_at > SAVE_PERIOD_S:
            self.save()
            self.saved_at = time.monotonic()

    def measure_if_due(self, state: Any) -> None:
        """Measure the policy if `watch` wants a measurement after this number of iterations."""
        done = int(state.iteration)
        if self.watch and _is_due(self.watch, done, self.total):
            self.measurements.append({"iteration": done, **self.watch.measure(state.params)})

    def save(self) -> None:
        """Write the new rows, the policy and the state; only the first process writes."""
        if not hosts.is_writer():
            return
        curve.append(self.run.folder, self.rows)
        if self.run.mirror:
            self.run.mirror(self.rows)
        if self.measurements:
            curve.append(self.run.folder, self.measurements, curve.WATCHED)
        self.rows, self.measurements = [], []
        if self.last:
            _save(self.run, *self.last)


@contextmanager
def _lost_process_explained(iteration: int, folder: Path) -> Iterator[None]:
    """Raise `WorkFailed` with advice if another process of the training has ended."""
    try:
        yield
    except Exception as error:
        if not hosts.is_process_lost(error):
            raise
        raise WorkFailed(
            f"another process of this training is gone, at iteration {iteration} "
            f"({str(error).splitlines()[0][:120]}). Repeat the command on every host: it resumes "
            f"from the state that the first host saved in {folder}"
        ) from error


def _is_due(watch: Watch, done: int, total: int) -> bool:
    """Return whether the policy is measured after `done` of `total` iterations."""
    return done % watch.every == 0 or done == total


def _is_missing(watch: Watch | None, folder: Path, done: int, total: int) -> bool:
    """Return whether a due measurement is missing because the run was interrupted."""
    if watch is None or not _is_due(watch, done, total):
        return False
    rows = curve.read(folder, curve.WATCHED)
    return not rows or rows[-1]["iteration"] < done


def _check_finite(iteration: int, row: dict[str, float], folder: Path) -> None:
    bad = [key for key, value in row.items() if not math.isfinite(value)]
    if bad:
        raise WorkFailed(
            f"training diverged at iteration {iteration}: {', '.join(bad)} not finite. The last "
            f"finite state is in {folder / 'state'}. Lower optimizer.rate or set optimizer.clip, "
            f"with another --out, and with --init-from {folder / 'policy'} to train its policy "
            "further. If it diverged in the first iterations, narrow the randomisation: a vehicle "
            "may tumble"
        )


def _save(run: Run, phase: RunPhase, state: Any) -> None:
    """Write the policy and the state to the run's folder."""
    training = {**run.origin, "iteration": int(state.iteration), "threads": threads()}
    seed, folder = run.config.seed, run.folder / "state"

    def save_state() -> None:
        arrays = tree_to_arrays(state)
        save_arrays(folder, arrays, kind="training", seed=seed, extra={"training": training})

    # The state is written last, so that the policy and the curve up to it are on the disk as well.
    # Only the first one is written before the policy, which could not be resumed without a state.
    if is_first := not folder.exists():
        save_state()
    save_policy(run.folder / "policy", state.params, phase.spec, seed=seed, training=training)
    if not is_first:
        save_state()


def _refuse_lost_state(policy: Path) -> None:
    """Refuse to train anew where a trained policy would be overwritten.

    Raises:
        ValueError: naming the policy, and what to do.
    """
    recover_folder(policy)
    # A run that was interrupted before its first iteration has saved random weights.
    if policy.exists() and read_config(policy).get("training", {}).get("iteration", 1):
        raise ValueError(
            f"{policy} is a trained policy, but {policy.with_name('state')}, from which its "
            f"training would resume, is missing; give another --out (with --init-from {policy} to "
            "train it further), or move it away to start over"
        )


def _resume(run: Run, fresh: Any) -> Any:
    """Return the state saved in the folder, or `fresh` if there is none.

    Rows of the curve after that state are removed.

    Raises:
        ValueError: if the folder has another run or a trained policy without a state, or the number
            of threads changed in a way that makes sums round differently.
    """
    origin, folder = run.origin, run.folder
    saved = folder / "state"
    recover_folder(saved)
    if not saved.exists():
        _refuse_lost_state(folder / "policy")
        folder.mkdir(parents=True, exist_ok=True)
        curve.cut(folder, 0)
        curve.cut(folder, 0, curve.WATCHED)
        return fresh
    try:
        checkpoint = load_arrays(saved, kind="training")
    except PolicyError as error:
        raise ValueError(
            f"{error}. Without a copy the training cannot be resumed: give another --out (with "
            f"--init-from {folder / 'policy'} to train its policy further), or remove the folder "
            "to start over"
        ) from error
    stored = checkpoint.config["training"]
    flags = {"from": "--init-from", "delta": "--delta"}
    options = [f"another {flag}" for key, flag in flags.items() if stored.get(key) != origin[key]]
    changes = options + differences(stored["config"], origin["config"])
    if changes:
        raise ValueError(
            f"{folder} holds another run ({first_changes(changes)}); repeat its options to resume "
            f"it, give another --out (with --init-from {folder / 'policy'} to train its policy "
            "further), or remove the folder to start over"
        )
    # One thread sums in another order than several threads.
    before, now = stored.get("threads", threads()), threads()
    if (before == 1) != (now == 1):
        raise ValueError(
            f"{folder} was trained with {before} threads of XLA, and now there are {now}: sums "
            f"would round differently from here on. Set NPROC={before} in the environment to "
            "resume with the same bits, or give another --out"
        )
    state = tree_from_arrays(fresh, checkpoint.arrays, str(saved))
    # A measurement after the last finished iteration stays.
    curve.cut(folder, int(state.iteration))
    curve.cut(folder, int(state.iteration) + 1, curve.WATCHED)
    return state

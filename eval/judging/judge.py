"""The judge: it flies many trials (flights) of one policy in one simulator, and scores them.

On one machine, a trial's outcome depends on (track, difficulty, seed) only, to the bit. So policies
are always called with the same number of rows, every row is computed separately, and trials share
no random numbers. A slot of the simulator takes the next trial when its trial has ended.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import numpy as np

from eval.judging.ages import Delays
from eval.judging.guard import ActionLimits, call_policy, check_rate, first_action, limits_of
from eval.judging.policy_checks.in_flight import Outputs
from eval.judging.recorder import Recorder
from eval.judging.sensors import Filtered, Sensors, single_steps
from eval.logs.flight import Flight
from eval.sensors import view_models
from eval.sensors.sensors_file import PERFECT, SensorSet
from eval.vehicles.vehicle import Vehicle
from eval.worlds import World, action_argument, compiles, world_class
from eval.worlds.slots import layout_of, slot_groups
from eval.worlds.trial import (
    FLYING,
    Rules,
    TrialResult,
    TrialSpec,
    result_columns,
    steps_to_next,
    track_of,
)
from policies.observation import View, observe
from policies.policy import Policy, check_is_policy
from tracks.common.work import Workers, run_pieces, usable_cores, worker_count
from tracks.families import check_family
from tracks.track import Track

MOST_A_PIECE = 640
"""Largest number of trials of a piece: the trials that one process flies at a time."""
Trial = TypeVar("Trial")
OnResult = Callable[[TrialResult, Flight | None], None]
"""A function that is called at the end of each trial, in any order, with the flight if recorded."""
Numbered = tuple[int, TrialSpec]
"""Index of a trial in the argument `trials` of `fly`, and the trial."""
Ended = tuple[int, TrialResult, Flight | None, str]
"""The index of a trial, its result, its flight if recorded, and why an action was missing."""


@dataclass(frozen=True)
class Record:
    """Which optional parts of flights are recorded."""

    depth: bool = False
    """Whether depth images are recorded, one for each decision of the policy."""


@dataclass(frozen=True)
class JudgeOptions:
    """Settings of the judge; `threads` and `workers` do not change outcomes."""

    slots: int = 128
    """Simultaneous trials, and rows of every call of the policy."""
    threads: int = 1
    """Threads for physics, in each process."""
    workers: Workers | None = None
    """Processes that share the trials; None: one for each core if there is enough work."""
    rules: Rules = field(default_factory=Rules)
    """When a trial ends."""
    limits: ActionLimits = field(default_factory=ActionLimits)
    """Limits of actions."""
    sensors: SensorSet = PERFECT
    """Sensor models of the policy's observation."""


@dataclass(frozen=True)
class Task:
    """Arguments of a process that flies a share of the trials, as in `fly`."""

    policy: Any
    vehicle: Vehicle
    world: str = "mujoco"
    options: JudgeOptions = field(default_factory=JudgeOptions)
    record: Record | None = None
    tracks: Mapping[str, Track] = field(default_factory=dict)


def fly(
    policy: Policy | Callable[[], Policy],
    trials: Sequence[TrialSpec],
    vehicle: Vehicle,
    world: str = "mujoco",
    options: JudgeOptions | None = None,
    on_result: OnResult | None = None,
    record: Record | None = None,
    tracks: Mapping[str, Track] | None = None,
) -> list[TrialResult]:
    """Fly every trial and return the results in the order of `trials`.

    An interrupt ends this function at once; results already passed to `on_result` are final.

    Args:
        policy: the policy, or a function without arguments that returns it. For several processes
            it must be picklable, such as `functools.partial(load_policy, name)`.
        trials: the trials to fly.
        vehicle: the vehicle that flies.
        world: name of the simulator, in `eval.worlds.WORLDS`.
        options: settings of the judge.
        on_result: called at the end of each trial.
        record: parts of the flights to record; None: flights are not recorded.
        tracks: custom tracks by their names in `trials`; other names are families.

    Raises:
        ValueError: for an unknown simulator or track, an object that is no policy, a policy faster
            than the physics, or one whose outputs are not actions.
        WorkerDied: where a worker process died twice with the same piece.
    """
    options = options or JudgeOptions()
    world_class(world)
    tracks = tracks or {}
    for trial in trials:
        if trial.track not in tracks:
            check_family(trial.track)
    task = Task(policy, vehicle, world, options, record, tracks)
    results: dict[int, TrialResult] = {}
    reasons: set[str] = set()

    def keep(piece: int, ended: Ended) -> None:
        index, result, flight, missing = ended
        if missing and missing not in reasons:
            reasons.add(missing)
            warnings.warn(f"{missing}; the trials that waited for it end as timeout", stacklevel=2)
        # A piece that was repeated, because its process died, returns some results again.
        is_repeated, results[index] = index in results, result
        if on_result and not is_repeated:
            on_result(result, flight)

    workers = _workers(task, len(trials))
    most_a_piece = len(trials) if compiles(world) else MOST_A_PIECE
    count = worker_count(workers)
    groups = ([(index, trials[index]) for index in group] for group in slot_groups(trials, tracks))
    shares = [share for group in groups for share in pieces_of(group, count, most_a_piece)]
    run_pieces(partial(fly_share, task), shares, workers, keep)
    return [results[index] for index in range(len(trials))]


def pieces_of(trials: Sequence[Trial], processes: int, most: int) -> list[Sequence[Trial]]:
    """Divide trials into pieces of at most `most` trials, with equally many pieces a process.

    Small pieces lose little when a process dies, but at the end of each piece some slots are empty.
    One process gets all trials in one piece.
    """
    if processes == 1:
        return [trials] if trials else []
    pieces = min(len(trials), processes * math.ceil(len(trials) / (most * processes)))
    # Neighbouring trials, which take similar time, go to different pieces.
    return [trials[k::pieces] for k in range(pieces)]


def _is_policy(policy: object) -> bool:
    """Return whether this is a policy, and not a function or class that makes one."""
    return not callable(policy) or (hasattr(policy, "act") and not isinstance(policy, type))


def _workers(task: Task, trials: int) -> Workers:
    """Return the number of processes for a number of trials, or the cluster's address."""
    requested = task.options.workers
    if isinstance(requested, int):
        return max(1, min(requested, trials))
    if requested is not None:
        return requested
    # A process takes seconds to start, and a policy object may not be picklable.
    if compiles(task.world) or _is_policy(task.policy) or trials < 2 * task.options.slots:
        return 1
    return usable_cores()


def fly_share(task: Task, share: Sequence[Numbered]) -> Iterator[Ended]:
    """Fly numbered trials in this process, and yield each one when it ends."""
    policy = task.policy if _is_policy(task.policy) else task.policy()
    check_is_policy(policy)
    options = task.options
    # In a compiling world, another number of slots is another program, which rounds otherwise.
    slots = options.slots if compiles(task.world) else min(options.slots, len(share))
    world = world_class(task.world)(
        task.vehicle, policy.spec.camera, layout_of(task.tracks.values()), options.rules,
        slots=slots, threads=options.threads, **action_argument(task.world, policy.spec.action),
    )  # fmt: skip
    yield from _Slots(task, policy, world).run(share)


class _Slots:
    """The slots of a simulator, with the trial and the policy's hidden state in each."""

    def __init__(self, task: Task, policy: Policy, world: World) -> None:
        rate = policy.spec.rate_hz
        check_rate(f"policy {policy.name!r}", rate, 1.0 / world.dt)
        self._task, self._policy, self._world = task, policy, world
        action = policy.spec.action
        self._limits = limits_of(task.options.limits, action, task.vehicle)
        self._first = first_action(action, task.vehicle)
        self._steps_a_decision = 1 / (rate * world.dt)
        slots = world.slots
        self._index = np.full(slots, -1)
        self._trial: list[TrialSpec | None] = [None] * slots
        self._decision = np.zeros(slots)
        self._action_b = np.tile(self._first, (slots, 1))
        self._outputs = Outputs(slots, action)
        self._late, self._missing = np.zeros(slots, bool), ""
        self._fresh = np.ones(slots, bool)
        self._hidden = policy.start(slots)
        self._recorder = None
        if task.record:
            self._recorder = Recorder(slots, task.record.depth, self._first, action.kind)
        sensors, self._sensors, self._delays = task.options.sensors, None, None
        self._filtered = None
        if sensors.estimator:
            layout = layout_of(task.tracks.values())
            corners = layout.gates * layout.corners
            self._filtered = Filtered(sensors, slots, world.dt, policy.spec.camera, corners)
        if view_models(sensors.models):
            self._sensors = Sensors(sensors, slots, rate, policy.spec.camera)
        if sensors.has_delay:
            self._delays = Delays(sensors.ages, slots, self._steps_a_decision, world.dt)

    def run(self, share: Sequence[Numbered]) -> Iterator[Ended]:
        """Fly the numbered trials; a slot takes the next one when its trial has ended."""
        waiting = list(reversed(share))
        integrator = getattr(self._world, "integrator", None)
        stepping = {"integrator": integrator, "step_s": self._world.dt} if integrator else {}
        while waiting or (self._index >= 0).any():
            self._fill(waiting)
            # A trial that ended at its start, as in a contact, makes no decision.
            if not self._ended().any():
                self._decide_and_fly()
            for slot in np.flatnonzero(self._ended()):
                index = int(self._index[slot])
                result = self._result(int(slot))
                flight = None
                if self._recorder:
                    flight = self._recorder.finish(int(slot), result._asdict() | stepping)
                self._index[slot] = -1
                yield index, result, flight, self._missing if self._late[slot] else ""

    def _ended(self) -> np.ndarray:
        """Return (N,) bool: slots whose trial has ended."""
        return (self._index >= 0) & ((self._world.progress.ended != FLYING) | self._late)

    def _fill(self, waiting: list[Numbered]) -> None:
        """Start waiting trials in the empty slots."""
        entries = []
        for slot in np.flatnonzero(self._index < 0).tolist():
            if not waiting:
                break
            self._index[slot], trial = waiting.pop()
            self._trial[slot] = trial
            self._decision[slot], self._action_b[slot] = 0, self._first
            self._outputs.start(slot)
            self._fresh[slot], self._late[slot] = True, False
            if self._recorder:
                self._recorder.start(slot)
            track = track_of(self._task.tracks, trial)
            if self._sensors:
                self._sensors.start(slot, trial)
            if self._delays:
                self._delays.start(slot, trial)
            if self._filtered:
                self._filtered.start(slot, trial, track.scene.gates)
            entries.append((slot, track, trial))
        if entries:
            self._world.load(entries)

    def _decide_and_fly(self) -> None:
        """Call the policy once, and fly its actions, except late ones, until the next decision."""
        spec, flying = self._policy.spec, self._index >= 0
        view = truth = self._current_view(flying)
        if self._delays:
            view = self._delays.see(view, self._fresh, flying)
        if self._sensors:
            view = self._sensors.see(view, self._fresh, flying)
        if self._filtered:
            view = self._filtered.see(view, truth, self._fresh, flying)
        state, image = observe(spec, view, self._action_b)
        state = np.where(flying[:, None], state, 0).astype(np.float32)
        image = image.astype(np.float32)
        guarded, self._hidden = call_policy(
            self._limits, self._policy, self._hidden, state, image,
            self._fresh | ~flying, self._action_b,
        )  # fmt: skip
        self._action_b = guarded.action_b
        self._outputs.add(guarded, state)
        self._late, self._missing = guarded.late, guarded.missing
        flying = flying & ~guarded.late
        self._fresh[:] = False
        if self._recorder:
            time_s = np.asarray(self._world.progress.step) * self._world.dt
            self._recorder.decided(np.flatnonzero(flying), time_s, self._action_b, view.depth_m)
        steps = steps_to_next(self._decision, self._steps_a_decision)
        self._fly_steps(np.where(flying, steps, 0), flying)
        self._decision += 1

    def _fly_steps(self, steps: np.ndarray, flying: np.ndarray) -> None:
        """Fly the actions for physics steps (N,), and take the views of delayed sensors."""
        done = np.zeros_like(steps)
        for moment in self._delays.moments(self._decision) if self._delays else ():
            part = np.minimum(steps, moment.pause)
            self._advance(part - done)
            done = part
            view = self._current_view(flying, moment.images & flying)
            for aged, due in moment.taken:
                aged.take(due, view)
        self._advance(steps - done)

    def _current_view(self, flying: np.ndarray, images: np.ndarray | None = None) -> View:
        """Return the current true view, with images in the slots `images` (None: all flying)."""
        view = self._world.view(flying if images is None else images)
        if not self._sensors:
            return view
        return view._replace(gate_number=np.array(self._world.progress.gates))

    def _advance(self, steps: np.ndarray) -> None:
        """Simulate physics steps (N,) in each slot; record them, and update the filters."""
        for part in single_steps(steps) if self._filtered else (steps,):
            for row in self._world.advance(self._action_b, part, bool(self._recorder)):
                if self._recorder:
                    self._recorder.add(row)
            if self._filtered:
                flew = (part > 0) & (self._world.progress.ended == FLYING)
                self._filtered.follow(self._world.view(np.zeros(len(part), bool)), flew)

    def _result(self, slot: int) -> TrialResult:
        """Return the result of the trial in `slot`, which has ended."""
        trial, task = self._trial[slot], self._task
        assert trial is not None
        columns = result_columns(self._world.progress, slot, self._world.dt)
        is_collision = columns["ended_by"] == "collision"
        return TrialResult(
            *trial,
            **columns,
            policy=self._policy.name,
            vehicle=task.vehicle.name,
            world=task.world,
            collided_with=self._world.collided_with(slot) if is_collision else None,
            **self._outputs.columns(slot),
        )

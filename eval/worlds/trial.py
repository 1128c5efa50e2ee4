"""Trials: their specification, end and score, with the same rules in every simulator.

The rules are pure functions of arrays over many trials (N rows), for numpy and JAX.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from eval.quadrotor.plant import Motion, Wrench
from tracks.families import make_track
from tracks.geometry.crossing import NEAR_RADIUS_M, crossing, is_near
from tracks.geometry.scene import Array, Gates
from tracks.track import Track

FLYING = 0
"""Code in `Progress.ended` of a running trial."""
ENDINGS = ("finished", "collision", "tipped", "timeout", "diverged")
"""Values of `ended_by`; `Progress.ended` is 1 + the index."""
FINISHED, COLLISION, TIPPED, TIMEOUT, DIVERGED = range(1, 6)


class TrialSpec(NamedTuple):
    """Specification of a trial; with policy and vehicle it determines the outcome."""

    track: str
    """Name of the family, or path of a custom track's file."""
    difficulty: int
    """Level, 0 to 9."""
    seed: int
    """Seed of the track and of all random numbers of the trial."""


class TrialResult(NamedTuple):
    """Outcome of a trial: a row of trials.parquet."""

    track: str
    difficulty: int
    seed: int
    policy: str
    vehicle: str
    world: str
    success: bool
    """All gates in order, no collision, in time."""
    gates_passed: int
    ended_by: str
    """One of `ENDINGS`."""
    collided_with: str | None
    """The solid's name, or None unless `ended_by` is collision."""
    pos_x: float
    """Position of the centre of mass at the end, world [m]; the last finite one if diverged."""
    pos_y: float
    pos_z: float
    time_s: float
    """Time at the end [s]; a finished trial's lap time."""
    v_max: float
    """Largest |vel_w| before any contact [m/s]."""
    v_mean: float
    """Mean |vel_w| [m/s]."""
    gates_8s: int
    """Gates passed within 8 s."""
    gates_035: int
    """Gates by the baseline's rule: within 0.35 m of the centres, in order."""
    bad_actions: int
    """Actions that were not finite; the last good one was flown instead."""
    limited_actions: int
    """Actions beyond the limit, which were reduced to it."""
    late_actions: int
    """1 where the policy exceeded a set deadline or gave no answer, which ends a trial as timeout;
    else 0."""
    decisions: int = 0
    """Decisions of the policy; 0 in files without this column."""
    output_max: float = 0.0
    """Largest absolute component of the policy's raw output; 0 for none."""
    action_up: float = 0.0
    """Mean vertical component of wanted net accelerations [m/s^2], counted as 0 where the vehicle
    does not climb; 0 for other actions."""

    @property
    def trial(self) -> TrialSpec:
        """The specification of the trial."""
        return TrialSpec(self.track, self.difficulty, self.seed)

    @property
    def ending(self) -> str:
        """The end as text, such as "collision with gate 3 frame"."""
        return self.ended_by + (f" with {self.collided_with}" if self.collided_with else "")


def track_of(tracks: Mapping[str, Track], trial: TrialSpec) -> Track:
    """Return the track that `trial` is flown on: one of the custom `tracks`, or its family's."""
    if trial.track in tracks:
        return tracks[trial.track]
    return make_track(trial.track, trial.difficulty, trial.seed)


@dataclass(frozen=True)
class Rules:
    """Rules for the end and the score of a trial."""

    time_limit_s: float = 20.0
    """A trial ends at this time [s]."""
    short_window_s: float = 8.0
    """Gates passed by this time count as `gates_8s` [s]."""
    near_radius_m: float = NEAR_RADIUS_M
    """The baseline's rule: a gate counts within this distance of its centre [m]."""
    speed_limit: float = 1e3
    """A body faster than this [m/s] has diverged."""
    rate_limit: float = 1e4
    """A body turning faster than this [rad/s] has diverged."""
    wrench_limit: float = 1e6
    """A force [N] or torque [N m] on the body beyond this has diverged."""


class Course(NamedTuple):
    """The gates of N trials, padded to the same number by repeating the last."""

    gates: Gates
    """(N, G, ...)."""
    count: Array
    """(N,) gates to pass, int32."""


class Progress(NamedTuple):
    """Progress of trials; all arrays are (N,) except `pos_w`."""

    step: Array
    """Physics steps flown, int32."""
    ended: Array
    """`FLYING` or one of the codes above, int32."""
    gates: Array
    """Gates crossed in order: also the number of the next gate, int32."""
    gates_8s: Array
    """Gates crossed within `Rules.short_window_s`, int32."""
    gates_035: Array
    """Gates by the baseline's rule, int32."""
    v_max: Array
    """[m/s]."""
    v_sum: Array
    """Sum of |vel_w| over the states judged so far [m/s]."""
    pos_w: Array
    """(N, 3) position at the last state judged [m]."""


def steps_to_next(decision: Array, period: float) -> Array:
    """Return the whole physics steps from each decision, given by its number, to the next.

    A `period` of 16.7 steps (30 Hz at 500 Hz of physics) alternates between 17, 16 and 17.
    """
    xp = decision.__array_namespace__()
    return (xp.rint((decision + 1) * period) - xp.rint(decision * period)).astype(int)


def start_progress(pos_w: Array) -> Progress:
    """Return the progress of trials about to start at pos_w (N, 3)."""
    xp = pos_w.__array_namespace__()
    count, real = xp.zeros(pos_w.shape[0], dtype=xp.int32), xp.zeros_like(pos_w[:, 0])
    return Progress(count, count, count, count, count, real, real, pos_w)


def next_gate(course: Course, number: Array) -> Gates:
    """Return each row's gate `number` (N,), or the last one beyond it, with arrays (N, ...)."""
    return Gates(*_rows_of(course, number, course.gates))


def next_centre(course: Course, number: Array) -> Array:
    """Return the centre (N, 3) of each row's gate `number` (N,), as `next_gate` does [m]."""
    return _rows_of(course, number, [course.gates.center_w])[0]


def _rows_of(course: Course, number: Array, fields: Sequence[Array]) -> list[Array]:
    xp = number.__array_namespace__()
    rows, at = xp.arange(number.shape[0]), xp.minimum(number, course.count - 1)
    return [field[rows, at] for field in fields]


def has_diverged(rules: Rules, motion: Motion) -> Array:
    """Return which states are not finite or impossibly fast, (N,) bool."""
    xp = motion.pos_w.__array_namespace__()
    # A comparison with NaN is false.
    speed_fits = (xp.abs(motion.vel_w) <= rules.speed_limit).all(-1)
    rate_fits = (xp.abs(motion.rate_b) <= rules.rate_limit).all(-1)
    return ~(xp.isfinite(motion.pos_w).all(-1) & speed_fits & rate_fits)


def is_wrench(rules: Rules, wrench: Wrench) -> Array:
    """Return which forces and torques are finite and possible, (N,) bool."""
    xp = wrench.force_b.__array_namespace__()
    both = xp.concatenate(wrench, axis=-1)
    return (xp.abs(both) <= rules.wrench_limit).all(-1)  # a comparison with NaN is false


def judge_state(
    rules: Rules,
    progress: Progress,
    course: Course,
    dt: float,
    motion: Motion,
    contact: Array,
    diverged: Array,
) -> Progress:
    """Return the progress after judging the states at physics step `progress.step`.

    A contact found in a state counts before a gate crossed on the way to it: a trial that touches
    the last gate's frame in the step in which it crosses has not finished.

    Args:
        rules: when a trial ends.
        progress: of N trials; ended rows are returned unchanged.
        course: the gates of each trial's track.
        dt: length of a physics step [s].
        motion: (N, ...) the states.
        contact: (N,) bool, the body is in contact.
        diverged: (N,) bool, the state is invalid and its numbers are ignored.
    """
    pos_w, rot_w, vel_w, _ = motion
    xp = pos_w.__array_namespace__()
    flying = progress.ended == FLYING
    live = flying & ~diverged
    free = live & ~contact
    gate = next_gate(course, progress.gates)
    passed, _ = crossing(gate.center_w, gate.rot_w, gate.opening_g, progress.pos_w, pos_w)
    gates = progress.gates + (passed & free & (progress.gates < course.count))
    near = is_near(next_centre(course, progress.gates_035), pos_w, rules.near_radius_m)
    gates_035 = progress.gates_035 + (near & free & (progress.gates_035 < course.count))
    speed = xp.sqrt((vel_w * vel_w).sum(-1))
    last_step, short_step = round(rules.time_limit_s / dt), round(rules.short_window_s / dt)

    ended = xp.where(free & (progress.step >= last_step), TIMEOUT, progress.ended)
    ended = xp.where(free & (rot_w[:, 2, 2] < 0), TIPPED, ended)
    ended = xp.where(free & (gates >= course.count), FINISHED, ended)
    ended = xp.where(live & contact, COLLISION, ended)
    ended = xp.where(flying & diverged, DIVERGED, ended)
    return Progress(
        step=progress.step,
        ended=ended.astype(xp.int32),
        gates=gates.astype(xp.int32),
        gates_8s=xp.where(progress.step <= short_step, gates, progress.gates_8s).astype(xp.int32),
        gates_035=gates_035.astype(xp.int32),
        v_max=xp.where(free, xp.maximum(progress.v_max, speed), progress.v_max),
        v_sum=xp.where(live, progress.v_sum + speed, progress.v_sum),
        pos_w=xp.where(live[:, None], pos_w, progress.pos_w),
    )

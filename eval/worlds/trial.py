"""Specification, end and score of a trial, with the same rules in every simulator.

The rules are pure functions of NumPy or JAX arrays, whose rows are N trials.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

from eval.quadrotor.plant import Motion, Wrench
from tracks.families import make_track
from tracks.geometry.crossing import crossing, is_near
from tracks.geometry.scene import Array, Gates
from tracks.input.ranges import Range, TimeLimit, check_ranges, check_type
from tracks.track import Track

FLYING = 0
"""Code in `Progress.ended` of a running trial."""
ENDINGS = ("finished", "collision", "tipped", "timeout", "diverged")
"""Values of `TrialResult.ended_by`; `Progress.ended` is 1 + the index."""
FINISHED, COLLISION, TIPPED, TIMEOUT, DIVERGED = range(1, 6)
"""Codes in `Progress.ended` of the `ENDINGS`, in their order."""
SHORT_WINDOW_S = 8.0
"""Gates passed by this time count as `gates_8s` [s]."""


class TrialSpec(NamedTuple):
    """Specification of a trial; with policy and vehicle it determines the outcome."""

    track: str
    """Name of a family of tracks, or path of a custom track's file."""
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
    """Whether all gates were passed in order, in time and without a collision."""
    gates_passed: int
    ended_by: str
    """One of `ENDINGS`."""
    collided_with: str | None
    """Name of the solid in a collision; None for other endings."""
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
    """Number of gates passed within 8 s."""
    gates_035: int
    """Number of gates passed by the rule of the baseline (Yu et al. 2025): within 0.35 m of their
    centres, in order."""
    bad_actions: int
    """Number of actions that were not finite; the last finite one was flown instead."""
    limited_actions: int
    """Number of actions beyond the limit, which were reduced to it."""
    late_actions: int
    """1 if the policy exceeded a given deadline or gave no answer, else 0; either ends the trial as
    a timeout."""
    decisions: int = 0
    """Number of decisions of the policy; 0 in files without this column."""
    output_max: float = 0.0
    """Largest absolute component of the policy's raw output; 0 without decisions."""
    action_up: float = 0.0
    """Mean vertical component of the accelerations that the policy commands [m/s^2]. A decision at
    which the drone does not climb counts as 0; other kinds of action have 0."""

    @property
    def trial(self) -> TrialSpec:
        """The specification of the trial."""
        return TrialSpec(self.track, self.difficulty, self.seed)

    @property
    def ending(self) -> str:
        """The end of the trial as text, such as "collision with gate 3 frame"."""
        return self.ended_by + (f" with {self.collided_with}" if self.collided_with else "")


def track_of(tracks: Mapping[str, Track], trial: TrialSpec) -> Track:
    """Return the track of `trial`: one of the custom `tracks` by name, or one of a family."""
    if trial.track in tracks:
        return tracks[trial.track]
    return make_track(trial.track, trial.difficulty, trial.seed)


@dataclass(frozen=True)
class Rules:
    """Rules for the end and the score of a trial."""

    time_limit_s: TimeLimit = 20.0
    """A trial ends at this time [s]."""
    speed_limit: Annotated[float, Range(0.0, 1e3, above=True)] = 1e3
    """A body faster than this [m/s] has diverged."""
    rate_limit: Annotated[float, Range(0.0, 1e4, above=True)] = 1e4
    """A body turning faster than this [rad/s] has diverged."""
    wrench_limit: Annotated[float, Range(0.0, 1e6, above=True)] = 1e6
    """A trial with a force [N] or torque [N m] on the body beyond this has diverged."""


def check_rules(rules: Rules) -> None:
    """Refuse rules of another type, or with a number outside its range.

    Raises:
        ValueError: naming the field, its value and what is allowed.
    """
    check_type("rules", rules, (Rules,), "an eval.worlds.trial.Rules")
    check_ranges(rules, "rules.")


class Course(NamedTuple):
    """The gates of N trials, padded to the same number by repeating the last one."""

    gates: Gates
    """Arrays (N, G, ...) of the gates."""
    count: Array
    """(N,) number of gates to pass, int32."""


class Progress(NamedTuple):
    """Progress of trials; all arrays are (N,) except `pos_w`."""

    step: Array
    """Number of simulated physics steps, int32."""
    ended: Array
    """`FLYING`, or `FINISHED` to `DIVERGED`, int32."""
    gates: Array
    """Number of gates crossed in order, which is the index of the next gate, int32."""
    gates_8s: Array
    """Number of gates crossed within `SHORT_WINDOW_S`, int32."""
    gates_035: Array
    """Number of gates by the baseline's rule, int32."""
    v_max: Array
    """Largest |vel_w| before any contact [m/s]."""
    v_sum: Array
    """Sum of |vel_w| over all steps [m/s]."""
    pos_w: Array
    """(N, 3) position at the last step [m]."""


def steps_to_next(decision: Array, period: float) -> Array:
    """Return the number of physics steps (N,) from each decision of the policy to the next.

    Decisions (N,) are numbered from 0 in a trial. A period of 16.7 physics steps (30 Hz with
    physics of 500 Hz) gives 17, 16 and 17 steps.
    """
    xp = decision.__array_namespace__()
    return (xp.rint((decision + 1) * period) - xp.rint(decision * period)).astype(int)


def start_progress(pos_w: Array) -> Progress:
    """Return the progress of trials that start at pos_w (N, 3) [m]."""
    xp = pos_w.__array_namespace__()
    zeros_int, zeros = xp.zeros(pos_w.shape[0], dtype=xp.int32), xp.zeros_like(pos_w[:, 0])
    return Progress(zeros_int, zeros_int, zeros_int, zeros_int, zeros_int, zeros, zeros, pos_w)


def next_gate(course: Course, number: Array) -> Gates:
    """Return gate `number` (N,) of each trial, at most its last gate, with arrays (N, ...)."""
    return Gates(*_select_gate(course, number, course.gates))


def next_centre(course: Course, number: Array) -> Array:
    """Return the centre (N, 3) [m] of the gate that `next_gate` returns."""
    return _select_gate(course, number, [course.gates.center_w])[0]


def _select_gate(course: Course, number: Array, fields: Sequence[Array]) -> list[Array]:
    """Return `fields` (N, G, ...) of gates, for gate `number` of each trial: (N, ...)."""
    xp = number.__array_namespace__()
    rows, gate = xp.arange(number.shape[0]), xp.minimum(number, course.count - 1)
    return [field[rows, gate] for field in fields]


def has_diverged(rules: Rules, motion: Motion) -> Array:
    """Return which states are not finite, or faster than the rules allow, (N,) bool."""
    xp = motion.pos_w.__array_namespace__()
    # A comparison with NaN is false.
    speed_valid = (xp.abs(motion.vel_w) <= rules.speed_limit).all(-1)
    rate_valid = (xp.abs(motion.rate_b) <= rules.rate_limit).all(-1)
    return ~(xp.isfinite(motion.pos_w).all(-1) & speed_valid & rate_valid)


def is_wrench(rules: Rules, wrench: Wrench) -> Array:
    """Return which forces and torques are finite and within the rules' limit, (N,) bool."""
    xp = wrench.force_b.__array_namespace__()
    force_and_torque = xp.concatenate(wrench, axis=-1)
    # A comparison with NaN is false.
    return (xp.abs(force_and_torque) <= rules.wrench_limit).all(-1)


def judge_state(
    rules: Rules,
    progress: Progress,
    course: Course,
    dt: float,
    motion: Motion,
    contact: Array,
    diverged: Array,
) -> Progress:
    """Apply the rules to the states at physics step `progress.step`, and return the new progress.

    A contact has priority over a gate crossed in the same step: a trial that touches the last
    gate's frame in the step in which it crosses the gate has not finished.

    Args:
        rules: rules for the end and the score of a trial.
        progress: progress of N trials; trials that have ended do not change.
        course: the gates of each trial's track.
        dt: length of a physics step [s].
        motion: (N, ...) the states.
        contact: (N,) bool, whether the body is in contact.
        diverged: (N,) bool, whether the state is invalid; its numbers are ignored.
    """
    pos_w, rot_w, vel_w, _ = motion
    xp = pos_w.__array_namespace__()
    flying = progress.ended == FLYING
    live = flying & ~diverged
    live_without_contact = live & ~contact
    center_w, rot_of_gate_w, opening_g = _select_gate(course, progress.gates, course.gates[:3])
    passed, _ = crossing(center_w, rot_of_gate_w, opening_g, progress.pos_w, pos_w)
    gates = progress.gates + (passed & live_without_contact & (progress.gates < course.count))
    is_at_next_centre = is_near(next_centre(course, progress.gates_035), pos_w)
    gates_035 = progress.gates_035 + (
        is_at_next_centre & live_without_contact & (progress.gates_035 < course.count)
    )
    speed = xp.sqrt((vel_w * vel_w).sum(-1))
    last_step, short_step = round(rules.time_limit_s / dt), round(SHORT_WINDOW_S / dt)

    ended = xp.where(live_without_contact & (progress.step >= last_step), TIMEOUT, progress.ended)
    ended = xp.where(live_without_contact & (rot_w[:, 2, 2] < 0), TIPPED, ended)
    ended = xp.where(live_without_contact & (gates >= course.count), FINISHED, ended)
    ended = xp.where(live & contact, COLLISION, ended)
    ended = xp.where(flying & diverged, DIVERGED, ended)
    return Progress(
        step=progress.step,
        ended=ended.astype(xp.int32),
        gates=gates.astype(xp.int32),
        gates_8s=xp.where(progress.step <= short_step, gates, progress.gates_8s).astype(xp.int32),
        gates_035=gates_035.astype(xp.int32),
        v_max=xp.where(live_without_contact, xp.maximum(progress.v_max, speed), progress.v_max),
        v_sum=xp.where(live, progress.v_sum + speed, progress.v_sum),
        pos_w=xp.where(live[:, None], pos_w, progress.pos_w),
    )


def result_columns(progress: Progress, slot: int, dt: float) -> dict[str, Any]:
    """Return the columns of `TrialResult` that follow from the progress of the trial in `slot`.

    A trial that has not ended counts as a timeout.
    """
    ended, step = int(progress.ended[slot]) or TIMEOUT, int(progress.step[slot])
    x, y, z = map(float, progress.pos_w[slot])
    speeds = step + (ended != DIVERGED)  # number of speeds in v_sum
    return {
        "success": ended == FINISHED,
        "gates_passed": int(progress.gates[slot]),
        "ended_by": ENDINGS[ended - 1],
        "pos_x": x,
        "pos_y": y,
        "pos_z": z,
        "time_s": step * dt,
        "v_max": float(progress.v_max[slot]),
        "v_mean": float(progress.v_sum[slot]) / max(speeds, 1),
        "gates_8s": int(progress.gates_8s[slot]),
        "gates_035": int(progress.gates_035[slot]),
    }

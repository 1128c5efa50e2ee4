"""From a track to a plan that the judge has flown: first plans, flown plans, flights in MuJoCo."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from eval.judging.judge import JudgeOptions, Record, fly
from eval.logs.flight import Flight
from eval.quadrotor.autopilot import Autopilot, make_autopilot
from eval.vehicles.vehicle import Controller, Vehicle
from eval.worlds.trial import TrialResult, TrialSpec, track_of
from suite.experiments.planning import solver
from suite.experiments.planning.course import course_of, passing
from suite.experiments.planning.first import Limits, first_plan, guess
from suite.experiments.planning.flown import flown_plan
from suite.experiments.planning.known import PlannedPolicy
from suite.experiments.planning.spline import along, packed, unpacked
from tracks.geometry.scene import Array
from tracks.track import Track

MARGIN_M = 0.02
"""Kept beside the radius around the body's box [m]."""
MORE_ROOM_M = 0.03
"""Kept in addition after each failed flight [m]."""
SLACK_S = 0.5
"""By which a flown plan may take longer than the first one [s]."""


@dataclass(frozen=True)
class Effort:
    """How hard a plan is looked for."""

    first: int = 160
    """Steps of the search by flatness."""
    flown: int = 30
    """Steps of the search through the quadrotor."""
    again: int = 12
    """Further ones after a flight that failed."""
    tries: int = 3
    """Flights in MuJoCo at most."""


class Plan(NamedTuple):
    """The fastest plan of a track that was found."""

    trial: TrialSpec
    numbers: list[float]
    """Of its spline."""
    model_s: float
    """Its lap in the differentiable quadrotor [s]."""
    flown: bool
    """Whether the judge has seen it finish."""
    ending: str
    """How the judge saw it end."""
    lap_s: float
    """And after what time [s]."""


def starts(vehicle: Vehicle) -> tuple[Limits, ...]:
    """Return what first plans may ask: near the vehicle's limits, and further from them.

    Attitude and rotors lag, which a first plan does not know: what asks for the most is not what
    is flown the fastest.
    """
    thrust, rate = vehicle.full_thrust, vehicle.controller.rate_max[0]
    return (
        Limits(0.88 * thrust, 0.1 * thrust, 0.67 * rate, 0.15),
        Limits(0.85 * thrust, 0.1 * thrust, 0.45 * rate, 0.2),
    )


def plans(
    vehicle: Vehicle,
    trials: Sequence[TrialSpec],
    effort: Effort,
    tell: Callable[[float], Any] = lambda done: None,
) -> list[Plan]:
    """Return a plan for each trial's track; they are looked for side by side.

    Args:
        vehicle: what flies.
        trials: of one family, so that their laps take about as long.
        effort: how hard is looked.
        tell: told how many of the first `effort.first + effort.flown` steps are done.
    """
    with jax.enable_x64(True):
        return _plans(vehicle, trials, effort, tell)


def fly_plan(
    vehicle: Vehicle, trial: TrialSpec, numbers: Sequence[float]
) -> tuple[TrialResult, Flight]:
    """Return how the judge sees a plan end in MuJoCo, and the flight."""
    policy = PlannedPolicy(track_of({}, trial), np.asarray(numbers), 1 / _period_s(vehicle))
    flights: list[Any] = []
    options = JudgeOptions(slots=1, workers=1)
    results = fly(
        policy, [trial], vehicle, "mujoco", options, lambda _, f: flights.append(f), Record()
    )
    return results[0], flights[0]


def _plans(
    vehicle: Vehicle, trials: Sequence[TrialSpec], effort: Effort, tell: Callable[[float], Any]
) -> list[Plan]:
    limits = starts(vehicle)
    asked = [trial for trial in trials for _ in limits]
    tracks = [track_of({}, trial) for trial in asked]
    room = np.full(len(asked), float(np.linalg.norm(vehicle.body.half_size)) + MARGIN_M)
    numbers = _first(tracks, list(limits) * len(trials), room, effort.first, tell)
    # Whole seconds: every other length is compiled anew.
    longest_s, period_s = np.ceil(numbers[:, -1].max() + SLACK_S), _period_s(vehicle)
    refine = _Refining(vehicle, round(longest_s / period_s))
    passed_s = _passed(tracks, room, numbers, period_s * np.arange(refine.ticks))
    best: dict[TrialSpec, Plan] = {}
    for attempt in range(effort.tries):
        steps = effort.again if attempt else effort.flown
        count = (lambda done: None) if attempt else lambda done: tell(effort.first + done)
        numbers, passed_s = refine(tracks, room, numbers, passed_s, steps, count)
        left = [row for row, trial in enumerate(asked) if not (trial in best and best[trial].flown)]
        for row in left:
            trial = asked[row]
            seen, _ = fly_plan(vehicle, trial, numbers[row])
            plan = Plan(
                trial, numbers[row].tolist(), float(passed_s[row, -1]), seen.success, seen.ending,
                seen.time_s,
            )  # fmt: skip
            if trial not in best or _merit(plan) > _merit(best[trial]):
                best[trial] = plan
        failed = np.array([not best[trial].flown for trial in asked])
        if not failed.any():
            break
        room = np.where(failed, room + MORE_ROOM_M, room)
    return [best[trial] for trial in trials]


def _period_s(vehicle: Vehicle) -> float:
    """Return the period of the attitude loop [s]."""
    autopilot = make_autopilot(vehicle)
    return autopilot.attitude_every * autopilot.dt


def _merit(plan: Plan) -> tuple[bool, float]:
    return plan.flown, -plan.lap_s


def _courses(tracks: Sequence[Track], room: np.ndarray) -> Any:
    return _stacked([course_of(track, keep) for track, keep in zip(tracks, room, strict=True)])


def _stacked(rows: Sequence[Any]) -> Any:
    return jax.tree.map(lambda *parts: np.stack(parts), *rows)


def _first(
    tracks: Sequence[Track],
    limits: Sequence[Limits],
    room: np.ndarray,
    steps: int,
    tell: Callable[[float], Any],
) -> np.ndarray:
    """Return the numbers (N, n) of first plans."""
    rest = (_courses(tracks, room), jax.tree.map(np.float64, _stacked(limits)))
    numbers = np.stack([np.asarray(packed(guess(track))) for track in tracks])
    search = solver.begin(numbers, _first_judged(numbers, rest))
    for count in range(steps):
        search = _first_step(search, rest)
        tell(count)
    return np.asarray(search.numbers)


def _passed(
    tracks: Sequence[Track], room: np.ndarray, numbers: np.ndarray, time_s: np.ndarray
) -> np.ndarray:
    """Return when first plans, seen at `time_s`, pass their gates (N, G) [s]."""
    found = []
    for track, keep, row in zip(tracks, room, numbers, strict=True):
        pos_w = along(unpacked(row), time_s).pos_w
        found.append(np.asarray(passing(course_of(track, keep), pos_w, time_s[1]).time_s))
    return np.stack(found)


class _Refining:
    """Plans brought on through the quadrotor, side by side."""

    def __init__(self, vehicle: Vehicle, ticks: int) -> None:
        autopilot = make_autopilot(vehicle)
        self.ticks, self._controller = ticks, autopilot.controller
        self._plant, self._every = autopilot.plant, autopilot.attitude_every

    def __call__(
        self,
        tracks: Sequence[Track],
        room: np.ndarray,
        numbers: np.ndarray,
        passed_s: np.ndarray,
        steps: int,
        tell: Callable[[float], Any],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return numbers (N, n) and passing times (N, G) after so many steps."""
        courses, done = _courses(tracks, room), 0
        for part in (steps // 2, steps - steps // 2):
            # The heading turns to the next gate when the last one was passed.
            judged, passed_s = self._do("look", numbers, courses, passed_s)
            search = solver.begin(numbers, judged)
            for _ in range(part):
                search = self._do("step", search, courses, passed_s)
                done += 1
                tell(done)
            numbers = np.asarray(search.numbers)
        return numbers, np.asarray(self._do("look", numbers, courses, passed_s)[1])

    def _do(self, what: str, at: Any, courses: Any, passed_s: Any) -> Any:
        rest = (courses, np.asarray(passed_s))
        return _flown(at, rest, what, self._plant, self._controller, self._every, self.ticks)


@jax.jit
def _first_judged(numbers: Array, rest: Any) -> solver.Judged:
    return jax.vmap(first_plan)(numbers, rest)


@jax.jit
def _first_step(search: solver.Search, rest: Any) -> solver.Search:
    return solver.step(first_plan, search, rest)


@partial(jax.jit, static_argnames=("what", "controller", "every", "ticks"))
def _flown(
    at: Any, rest: Any, what: str, plant: Any, controller: Controller, every: int, ticks: int
) -> Any:
    """Look at numbers `at` (N, n), or go a step further from the search `at`."""
    flown = partial(
        flown_plan, Autopilot(plant, controller, 1 / controller.frequency, every), ticks
    )
    if what == "look":
        return jax.vmap(flown)(at, rest)
    return solver.step(lambda numbers, rest: flown(numbers, rest)[0], at, rest)

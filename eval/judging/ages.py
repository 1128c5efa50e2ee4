"""The sensor model `delay` in the judge: states and images that are old at a decision.

Views are taken between decisions, at the physics step that precedes their decision by the age, and
stored until then. With jitter, each decision has its own age from the trial's seed. At the start of
a trial, before any view is old enough, the policy gets the first view.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from eval.sensors.interface import Ages
from eval.worlds.slots import IMAGE_AGES, STATE_AGES, generator_of
from eval.worlds.trial import TrialSpec
from policies.observation import View
from tracks.common.masks import select


class Due(NamedTuple):
    """Views to take before the next decision, for one later decision."""

    pause: np.ndarray
    """(N,) physics steps after the last decision."""
    rows: np.ndarray
    """(N,) bool: slots with such a view."""
    place: int
    """Index among the stored views."""


class Moment(NamedTuple):
    """A time between two decisions at which views are taken."""

    pause: np.ndarray
    """(N,) physics steps after the last decision, never less than the moment's before."""
    images: np.ndarray
    """(N,) bool: slots whose image is needed."""
    taken: list[tuple[Aged, Due]]
    """Uses of the view; `Due.rows` are the slots at their pause."""


class Aged:
    """Delayed views of N slots."""

    def __init__(
        self, age_s: float, jitter: float, slots: int, period_steps: float, dt: float
    ) -> None:
        """Make it for an age.

        Args:
            age_s: the mean [s].
            jitter: each decision's age is up to this share of the mean more or less, evenly [1].
            slots: how many.
            period_steps: physics steps between decisions.
            dt: their length [s].
        """
        self._mean, self._jitter, self._period = age_s / dt, jitter, period_steps
        longest = self._mean * (1.0 + jitter)
        self.ahead = math.ceil(longest / period_steps - 1e-9)
        """Largest number of decisions between taking a view and using it."""
        self._draws = [np.random.default_rng(0)] * slots
        self._ages = np.full((self.ahead, slots), self._mean)
        self._kept: list[View] = []

    def start(self, slot: int, draws: np.random.Generator) -> None:
        """Begin in `slot` a trial whose ages come from `draws`."""
        self._draws[slot] = draws

    def see(self, now: View, fresh: np.ndarray, flying: np.ndarray) -> View:
        """Return the delayed view at a decision.

        Args:
            now: the view without delay.
            fresh: (N,) bool, slots whose trial begins: they get `now`.
            flying: (N,) bool, slots in flight.
        """
        if not self.ahead:
            return now
        if self._jitter:
            self._draw(fresh, flying)
        kept = self._kept or [now] * self.ahead
        oldest, *rest = (select(fresh, now, view) for view in kept)
        self._kept = [*rest, now]
        return oldest

    def _draw(self, fresh: np.ndarray, flying: np.ndarray) -> None:
        """Draw the age for the last future decision; for all of them in fresh slots."""
        self._ages = np.roll(self._ages, -1, axis=0)
        for slot in np.flatnonzero(flying).tolist():
            count = self.ahead if fresh[slot] else 1
            share = self._draws[slot].uniform(1.0 - self._jitter, 1.0 + self._jitter, count)
            self._ages[-count:, slot] = self._mean * share

    def due(self) -> Iterator[Due]:
        """Yield the views to take before the next decision."""
        periods = np.maximum(np.ceil(self._ages / self._period - 1e-9), 1)
        for place, ages in enumerate(self._ages):
            rows = periods[place] == place + 1
            if rows.any():
                pause = np.rint((place + 1) * self._period - ages).astype(int)
                yield Due(np.where(rows, pause, 0), rows, place)

    def take(self, due: Due, view: View) -> None:
        """Store the current view."""
        self._kept[due.place] = select(due.rows, view, self._kept[due.place])


class Delays:
    """Ages of states and images in the slots of a judge."""

    def __init__(self, ages: Ages, slots: int, period_steps: float, dt: float) -> None:
        """Make it for `ages` and the physics steps between decisions and their length [s]."""
        self.state, self.image = (
            Aged(age_s, ages.jitter, slots, period_steps, dt)
            for age_s in (ages.state_s, ages.image_s)
        )

    def start(self, slot: int, trial: TrialSpec) -> None:
        """Begin `trial` in `slot`."""
        self.state.start(slot, generator_of(trial, STATE_AGES))
        self.image.start(slot, generator_of(trial, IMAGE_AGES))

    def see(self, now: View, fresh: np.ndarray, flying: np.ndarray) -> View:
        """Return the delayed view at a decision; see `Aged.see`."""
        depth_m = self.image.see(now, fresh, flying).depth_m
        return self.state.see(now, fresh, flying)._replace(depth_m=depth_m)

    def moments(self) -> Iterator[Moment]:
        """Yield the times at which views are taken before the next decision, in order."""
        whose = [(aged, due) for aged in (self.state, self.image) for due in aged.due()]
        if not whose:
            return
        pauses = np.array([due.pause for _, due in whose])
        for turn in np.argsort(pauses, axis=0, kind="stable"):
            taken = [(aged, due._replace(rows=due.rows & (turn == number)))
                     for number, (aged, due) in enumerate(whose)]  # fmt: skip
            nobody = np.zeros(len(turn), bool)
            images = [due.rows for aged, due in taken if aged is self.image]
            pause = np.take_along_axis(pauses, turn[None], axis=0)[0]
            yield Moment(pause, np.any([nobody, *images], axis=0), taken)

"""The sensor model `delay` in the judge: the policy observes states and images of an earlier time.

A view is the observable state with the depth image; its age is the delay after which the policy
uses it. A view is taken at the physics step that precedes its decision by the age, and is stored
until the decision. With jitter, each decision has its own random age from the trial's seed. At the
start of a trial, before any view is old enough, the policy gets the first view.
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
    """Views that must be taken before the next decision, all for the same later decision."""

    pause: np.ndarray
    """(N,) number of physics steps from the last decision to the view."""
    rows: np.ndarray
    """(N,) bool, slots in which such a view must be taken."""
    place: int
    """Index of the view among the stored views."""


class Moment(NamedTuple):
    """A time between two decisions at which views are taken."""

    pause: np.ndarray
    """(N,) number of physics steps after the last decision, not below that of an earlier moment."""
    images: np.ndarray
    """(N,) bool, slots whose image is needed."""
    taken: list[tuple[Aged, Due]]
    """Storages of the view; `Due.rows` are the slots whose view is taken at this time."""


class Aged:
    """Delayed views of N slots."""

    def __init__(
        self, age_s: float, jitter: float, slots: int, period_steps: float, dt: float
    ) -> None:
        """Make the storage of views with the mean age `age_s` [s].

        Ages are uniformly distributed between (1 - jitter) and (1 + jitter) times the mean.
        Decisions are `period_steps` physics steps apart, of `dt` each [s].
        """
        self._mean, self._jitter, self._period = age_s / dt, jitter, period_steps
        longest = self._mean * (1.0 + jitter)
        self.ahead = math.ceil(longest / period_steps - 1e-9)
        """Largest number of decisions from taking a view to using it."""
        self._rngs = [np.random.default_rng(0)] * slots
        self._ages = np.full((self.ahead, slots), self._mean)
        self._stored: list[View] = []

    def start(self, slot: int, rng: np.random.Generator) -> None:
        """Begin a trial in `slot`, whose random ages come from `rng`."""
        self._rngs[slot] = rng

    def see(self, now: View, fresh: np.ndarray, flying: np.ndarray) -> View:
        """Return the delayed view at a decision; `now` is the view without delay.

        Slots whose trial begins (`fresh`, (N,) bool) get `now`; `flying` (N,) bool are in flight.
        """
        if not self.ahead:
            return now
        if self._jitter:
            self._draw_ages(fresh, flying)
        stored = self._stored or [now] * self.ahead
        oldest, *newer = (select(fresh, now, view) for view in stored)
        self._stored = [*newer, now]
        return oldest

    def _draw_ages(self, fresh: np.ndarray, flying: np.ndarray) -> None:
        """Draw the age for the last future decision; in fresh slots, for all future decisions."""
        self._ages = np.roll(self._ages, -1, axis=0)
        for slot in np.flatnonzero(flying).tolist():
            count = self.ahead if fresh[slot] else 1
            factor = self._rngs[slot].uniform(1.0 - self._jitter, 1.0 + self._jitter, count)
            self._ages[-count:, slot] = self._mean * factor

    def due(self, decision: np.ndarray) -> Iterator[Due]:
        """Yield the views to take between the decisions with these numbers (N,) and the next."""
        # Physics steps of this decision, the next one, and so on.
        step = np.rint((decision + np.arange(self.ahead + 1)[:, None]) * self._period)
        for place, ages in enumerate(self._ages):
            taken = np.rint(step[place + 1] - ages)
            # A view without age is taken at the next decision itself.
            rows = (taken >= step[0]) & ((taken < step[1]) | (place == 0))
            if rows.any():
                yield Due(np.where(rows, taken - step[0], 0).astype(int), rows, place)

    def take(self, due: Due, view: View) -> None:
        """Store the current view in the slots of `due`."""
        self._stored[due.place] = select(due.rows, view, self._stored[due.place])


class Delays:
    """Delayed states and delayed images of N slots."""

    def __init__(self, ages: Ages, slots: int, period_steps: float, dt: float) -> None:
        """Make the storages; the other arguments are those of `Aged`."""
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

    def moments(self, decision: np.ndarray) -> Iterator[Moment]:
        """Yield the times at which views are taken after `decision` (N,), see `Aged.due`, in order.

        They are not after the next decision.
        """
        uses = [(aged, due) for aged in (self.state, self.image) for due in aged.due(decision)]
        if not uses:
            return
        pauses = np.array([due.pause for _, due in uses])
        # In each slot the uses are sorted by time: `use` (N,) is the number of the next one.
        for use in np.argsort(pauses, axis=0, kind="stable"):
            taken = [(aged, due._replace(rows=due.rows & (use == number)))
                     for number, (aged, due) in enumerate(uses)]  # fmt: skip
            no_slot = np.zeros(len(use), bool)
            images = [due.rows for aged, due in taken if aged is self.image]
            pause = np.take_along_axis(pauses, use[None], axis=0)[0]
            yield Moment(pause, np.any([no_slot, *images], axis=0), taken)

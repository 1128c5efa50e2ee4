"""States and images that are old when a policy decides, and images that never come.

Views are taken between decisions, at the physics step that lies an age before the decision that
will see them, and kept until then. At a trial's start, before anything is old enough, the policy
sees the start.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from eval.judging.sensors import SensorNoise
from eval.worlds.slots import LOSSES, generator_of
from eval.worlds.trial import TrialSpec
from policies.observation import View
from tracks.common.tree_rows import select


class Aged:
    """Views of N slots that are seen one age after they were taken."""

    def __init__(self, age_s: float, period_steps: float, dt: float) -> None:
        """Make it for an age [s], the physics steps between decisions and their length [s]."""
        steps = age_s / dt
        self.periods = math.ceil(steps / period_steps - 1e-9)
        """Decisions from the one before a view is taken to the one that sees it."""
        self.pause = round(self.periods * period_steps - steps)
        """Physics steps from a decision to the next view."""
        self._kept: list[Any] = []

    def see(self, now: View, fresh: np.ndarray) -> View:
        """Return what is old enough at a decision, for rows that are `fresh` (N,) what is now."""
        if not self.periods:
            return now
        kept = self._kept or [now] * self.periods
        oldest, *self._kept = (select(fresh, now, view) for view in kept)
        return oldest

    def take(self, view: View) -> None:
        """Keep what is seen now."""
        self._kept.append(view)


class Delays:
    """Ages of states and images, and losses of images, in the slots of a judge."""

    def __init__(self, noise: SensorNoise, slots: int, period_steps: float, dt: float) -> None:
        """Make it for `noise` and the physics steps between decisions and their length [s]."""
        self._loss = noise.image_loss
        self.state = Aged(noise.state_age_s, period_steps, dt)
        self.image = Aged(noise.image_age_s, period_steps, dt)
        self._draws = [np.random.default_rng(0)] * slots
        self._shown: np.ndarray | None = None

    @property
    def pauses(self) -> list[tuple[int, Aged]]:
        """When to take a view after a decision [physics steps], and for which."""
        used = [(aged.pause, aged) for aged in (self.state, self.image) if aged.periods]
        return sorted(used, key=lambda pair: pair[0])

    def start(self, slot: int, trial: TrialSpec) -> None:
        """Begin `trial` in `slot`."""
        self._draws[slot] = generator_of(trial, LOSSES)

    def see(self, now: View, fresh: np.ndarray, flying: np.ndarray) -> View:
        """Return what there is to see at a decision.

        Args:
            now: what an ideal policy would see.
            fresh: (N,) bool, slots whose trial begins.
            flying: (N,) bool, the slots that fly.
        """
        depth_m = self.image.see(now, fresh).depth_m
        if self._loss:
            lost = np.zeros(len(fresh), bool)
            for slot in np.flatnonzero(flying).tolist():
                lost[slot] = self._draws[slot].random() < self._loss
            before = depth_m if self._shown is None else self._shown
            depth_m = np.where((lost & ~fresh)[:, None, None], before, depth_m)
            self._shown = depth_m
        return self.state.see(now, fresh)._replace(depth_m=depth_m)

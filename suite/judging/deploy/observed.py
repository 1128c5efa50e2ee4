"""What a policy is given on flights of the judge: what its 8-bit export is scaled by."""

from __future__ import annotations

from typing import Any

import numpy as np

from eval.judging.judge import JudgeOptions, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import TrialSpec
from policies.formats.c.forward import Observed
from policies.policy import Hidden, Policy
from policies.spec import PolicySpec

TRACK = "random"
"""The training distribution: an export is not scaled by the tracks that it is judged on."""
LEVELS = tuple(range(10))
SEED = 900_000
"""Of the first flight; no table is flown from it."""


class Listener:
    """A policy that keeps what it was given, row by row of the judge's slots."""

    def __init__(self, policy: Policy) -> None:
        """Listen to what `policy` is given."""
        self._policy = policy
        self._given: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    @property
    def name(self) -> str:
        """What tables call it."""
        return self._policy.name

    @property
    def spec(self) -> PolicySpec:
        """The policy's own."""
        return self._policy.spec

    def start(self, n: int) -> Hidden:
        """Return the policy's memory of n trials."""
        return self._policy.start(n)

    def act(
        self, hidden: Hidden, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, Hidden]:
        """Return what the policy answers."""
        self._given.append((state.copy(), image.copy(), fresh.copy()))
        return self._policy.act(hidden, state, image, fresh)

    def heard(self) -> Observed:
        """Return all of it, flight after flight; rows in which nothing flew are left out."""
        state, image, fresh = (np.stack(each, 1) for each in zip(*self._given, strict=True))
        flew = np.abs(state).max(-1) > 0
        parts: list[Any] = [x[flew] for x in (state, image, fresh)]
        return Observed(*parts)


def observed_flights(
    policy: Policy, vehicle: str = "reference", levels: tuple[int, ...] = LEVELS
) -> Observed:
    """Return what `policy` is given on one flight of a random track at each level."""
    listener = Listener(policy)
    trials = [TrialSpec(TRACK, level, SEED + k) for k, level in enumerate(levels)]
    options = JudgeOptions(slots=len(trials), workers=1)
    fly(listener, trials, load_vehicle(vehicle), options=options)
    return listener.heard()
